"""The options of the trainings of tests, as small as what they test allows."""

from dataclasses import replace

from rendezview_ground.learn.options import TrainingOptions

# Contour points, and next to no trees.
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

# Contour points of 42 views, for poses next to a prior.
CONTOURS_ALONE = replace(
    REFINING,
    order=1,
    contour_radii=(1.0,),
    surface_points=0,
    shadowed_silhouettes=False,
    sketches=False,
    forest_trees=0,
)

# Every stage of a training, each in several shards if it can have them.
EVERY_STAGE = TrainingOptions(
    order=1,
    bins=60,
    smooth_bins=3,
    resolution_px=64,
    perturbed_views=280,  # five shards
    held_out_views=20,
    contour_points=20,
    contour_radii=(1.0,),
    contour_resolution_px=64,
    surface_points=64,
    forest_trees=2,
)
FEW_STAGES = replace(
    EVERY_STAGE, surface_points=0, shadowed_silhouettes=False, sketches=False, forest_trees=0
)
