"""Colours of mesh files as linear albedo, one colour per face.

8-bit values, ``Kd`` (OBJ) and ``diffuse`` (DAE) are sRGB, as on a screen, and are converted to
linear values. Factors and vertex colours of glTF are linear by its specification.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendezview.geometry.pose import Array

Rgb = NDArray[np.float32]
GREY = 0.6  # linear albedo without a colour in the file

# Barycentric weights of the four places at which a texture is read in each triangle.
_TEXTURE_PLACES = np.array([[2, 2, 2], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6.0


def linear_from_srgb(srgb: Any) -> Array:
    """Linear intensity of sRGB values in [0, 1] (IEC 61966-2-1)."""
    values = np.clip(np.asarray(srgb, dtype=np.float64), 0.0, 1.0)
    linear: Array = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return linear


def unit_range(values: Any) -> Array:
    """Integers of 8 or 16 bits as [0, 1]; floats clipped to it."""
    array = np.asarray(values)
    if array.dtype.kind in "iu":
        return array.astype(np.float64) / np.iinfo(array.dtype).max
    return np.clip(array.astype(np.float64), 0.0, 1.0)


def grey(count: int) -> Rgb:
    """The colour of faces without a colour in the file."""
    return np.full((count, 3), GREY, dtype=np.float32)


def texture_face_rgb(image: Any, corner_uv: Array) -> Array:
    """Mean linear colour of a Pillow image over each triangle, read at four places.

    Args:
        image: Pillow image, sRGB.
        corner_uv: (F, 3, 2) texture coordinates, v upwards; the texture repeats.
    """
    pixels = np.asarray(image.convert("RGB"))
    height, width = pixels.shape[:2]
    uv = np.einsum("pc,fcd->pfd", _TEXTURE_PLACES, np.nan_to_num(corner_uv)) % 1.0
    column = np.minimum((uv[..., 0] * width).astype(np.int64), width - 1)
    row = np.minimum(((1.0 - uv[..., 1]) * height).astype(np.int64), height - 1)
    mean: Array = linear_from_srgb(pixels[row, column] / 255.0).mean(axis=0)
    return mean


def visual_face_rgb(geometry: Any, linear: bool, ignore_white: bool) -> Rgb | None:
    """Face colours of one trimesh geometry, or None.

    Args:
        geometry: ``trimesh.Trimesh``.
        linear: factors and vertex colours are linear already (glTF).
        ignore_white: a white material replaces a texture that could not be read.
    """
    visual, faces = geometry.visual, np.asarray(geometry.faces)
    decode = unit_range if linear else lambda values: linear_from_srgb(unit_range(values))
    kind = getattr(visual, "kind", None)
    if kind == "face" and len(visual.face_colors) == len(faces):
        rgb: Array = decode(visual.face_colors)[:, :3]
        return rgb.astype(np.float32)
    if kind == "vertex" and len(visual.vertex_colors) == len(geometry.vertices):
        rgb = decode(visual.vertex_colors)[faces, :3].mean(axis=1)
        return rgb.astype(np.float32)
    if kind != "texture":
        return None
    material = _material_rgb(visual, faces, decode, ignore_white)
    corner = visual.vertex_attributes.get("color")
    if corner is not None and len(corner) == len(geometry.vertices):
        tint = decode(corner)[faces, :3].mean(axis=1)
        material = tint if material is None else material * tint
    return None if material is None else material.astype(np.float32)


def _material_rgb(visual: Any, faces: Any, decode: Any, ignore_white: bool) -> Array | None:
    """Base colour, multiplied by the texture if it has coordinates."""
    material = visual.material
    factor = getattr(material, "baseColorFactor", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    rgb: Array | None = None
    if factor is not None and not (ignore_white and image is None and np.min(factor[:3]) == 255):
        rgb = np.tile(decode(np.asarray(factor))[:3], (len(faces), 1))
    if image is not None and visual.uv is not None and len(visual.uv) > 0:
        texture = texture_face_rgb(image, np.asarray(visual.uv, dtype=np.float64)[faces])
        rgb = texture if rgb is None else rgb * texture
    return rgb


def stl_face_rgb(attributes: NDArray[np.uint16], header: bytes) -> tuple[Rgb, int] | None:
    """Colours in the attribute words of a binary STL, and the number of faces with a colour.

    Two conventions exist, each with five bits per channel. VisCAM: bit 15 set means the word is
    a colour, blue in the low bits. Materialise Magics: the header holds ``COLOR=`` and
    the RGBA of the whole part, bit 15 clear means the word is a colour, red in the low bits.
    """
    place = header.find(b"COLOR=")
    flagged = (attributes & 0x8000) != 0
    low, middle, high = (((attributes >> shift) & 31) / 31.0 for shift in (0, 5, 10))
    if place >= 0 and len(header) >= place + 9:
        part = linear_from_srgb(np.frombuffer(header[place + 6 : place + 9], np.uint8) / 255.0)
        own = linear_from_srgb(np.stack([low, middle, high], axis=1))
        rgb = np.where(flagged[:, None], part, own)
        return rgb.astype(np.float32), len(rgb)
    if not flagged.any():
        return None
    own = linear_from_srgb(np.stack([high, middle, low], axis=1))
    return np.where(flagged[:, None], own, GREY).astype(np.float32), int(flagged.sum())
