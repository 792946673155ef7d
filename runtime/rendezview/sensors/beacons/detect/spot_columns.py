"""Columns of the table of spots that the compiled loops fill."""

# Source: by construction
X, Y, AREA, AMPLITUDE, PEAK, SIZE, SATURATED, SIGMA = range(8)
BINARY_X, BINARY_Y, WEIGHTED_X, WEIGHTED_Y, LEFT, TOP, RIGHT, BOTTOM, SHAPE, DARK, ABOVE = range(
    8, 19
)
# grey²: texture of the ring about it, as white noise of a pixel. Source: by construction
ROUGH = 19
# Elongation of the moments under its window: (xx − yy, 2 xy) / (xx + yy); NaN where saturated.
LONG_X, LONG_XY = 20, 21  # Source: by construction
RIVALS = 22  # spots like it beside it, where a window was read. Source: by construction
COVER = 23  # px, the share of SIGMA by what lies over it. Source: by construction
COLUMNS = 24  # Source: by construction
