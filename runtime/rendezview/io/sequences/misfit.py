"""Says which camera a picture of another size would fit."""

from __future__ import annotations

from rendezview.geometry.camera import Camera

_BINNINGS = range(2, 17)  # Source: cameras as sold bin 2 to 8 pixels


def misfit(width: int, height: int, camera: Camera) -> str:
    """Why a picture of this size is not the camera's, and which camera would fit."""
    said = (
        f"the image is {width} × {height} pixels but its camera {camera.width} × {camera.height}: "
    )
    across, down = camera.width / width, camera.height / height
    binned = [n for n in _BINNINGS if (camera.width // n, camera.height // n) == (width, height)]
    if binned:
        return said + (
            f"if its pixels are binned {binned[0]} × {binned[0]}, put `binning: {binned[0]}` into "
            "the camera file"
        )
    if (height, width) == (camera.height, camera.width)[::-1]:
        return said + "it is rotated by 90°: store it as the camera takes it"
    if abs(across - down) * max(width, height) <= max(1.0, across):  # equal within a pixel
        return said + (
            f"it was resized by {1.0 / across:.4g}: calibrate pictures of this size, or use the "
            "pictures as the camera takes them"
        )
    if width <= camera.width and height <= camera.height:
        return said + (
            "if it is a region of the calibrated picture, put `roi: {x_offset: …, y_offset: …, "
            f"width: {width}, height: {height}}}` into the camera file"
        )
    return said + "use the camera file of these images"
