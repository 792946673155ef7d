"""Columns of the table of spots that the compiled loops fill.

ROUGH: texture of the ring about a spot, grey², as white noise of a pixel. LONG_X, LONG_XY:
elongation of the moments under its window, (xx − yy, 2 xy) / (xx + yy), NaN where saturated.
RIVALS: spots like it beside it, where a window was read. COVER: px, the share of SIGMA by what lies
over it.
"""

# Source: by construction
X, Y, AREA, AMPLITUDE, PEAK, SIZE, SATURATED, SIGMA = range(8)
BINARY_X, BINARY_Y, WEIGHTED_X, WEIGHTED_Y, LEFT, TOP, RIGHT, BOTTOM, SHAPE, ABOVE = range(8, 18)
ROUGH, LONG_X, LONG_XY, RIVALS, COVER, COLUMNS = range(18, 24)
