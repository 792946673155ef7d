"""The stages in which a pose is moved onto the edges of a frame, from coarse to fine."""

from __future__ import annotations

import numpy as np

from rendezview.sensors.appearance.edges.alignment import CUT_SPREADS, SPREAD, Stage

# Many starting poses are aligned roughly. Source: pose-accuracy, seeds 1, 88, 99, 123
ROUGH = np.array([Stage(20, 9, 2, smooth_px=4, room_px=4, stride=4)])
# The better ones then coarsely. Source: the same
COARSE = np.array([Stage(10, 4, 3, smooth_px=2, room_px=2, stride=2), Stage(5, 1.5, 2)])
# Each stage iterates to convergence before the search range shrinks: attitudes 5° apart can lie
# within half a pixel of each other. The last one uses the three nearest views (commit 5e90c44).
# Source: seeds 1, 88, 99 and 123 of pose-accuracy, docs/notes/refinement.md
FINE = np.array(
    [
        Stage(8, 3, 3, room_px=2, stop_px=1.0),
        Stage(6, 2, 3, damping=1e-4, relaxation=1.3, stop_px=0.6),
        Stage(5, 1.2, 10, lines=3, fit=1, damping=1e-4, relaxation=1.3, stop_px=0.4),
        Stage(4, 0.5, 1, lines=3, fit=1, views=3, damping=1e-4, relaxation=1.3),
    ]
)
# Of the stages above, before a pose is given up. Source: 0.5 % of right poses lost, twelve-sides,
# frames of docs/notes/rivals.md
COARSE_STAGES = 1
CUT_PX = CUT_SPREADS * FINE[-1, SPREAD]  # px. Source: by construction, of the last stage
# Where the craft may differ from its mesh, no edge is in place to half a pixel. Source: commit
# 5cde9da
INEXACT = FINE[:-1]
INEXACT_CUT_PX = CUT_SPREADS * INEXACT[-1, SPREAD]  # px. Source: by construction, the same
