"""The training options of the tests that need contour points and next to no trees."""

from rendezview_ground.learn.options import TrainingOptions

REFINING = TrainingOptions(
    order=2,
    bins=90,
    smooth_bins=3,
    resolution_px=128,
    perturbed_views=100,
    held_out_views=50,
    contour_radii=(1.0, 2.0),
    contour_resolution_px=256,
)
