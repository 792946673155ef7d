"""The options that say where in the frames the target is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy.typing as npt
import typer

from rendezview.cli.inputs import numbers_of
from rendezview.errors import RendezviewError
from rendezview.io.sequences import Sequence
from rendezview.io.where_to_look import Where, boxes_by_frame, each_box, masks_by_frame

Box = Annotated[
    str | None, typer.Option(help="'x,y,width,height', px: where the target is in the first frame.")
]
Boxes = Annotated[
    Path | None,
    typer.Option(help="Where it is in each frame: a detector's boxes, JSON in BOP's form."),
]
Instances = Annotated[
    int,
    typer.Option(min=1, help="With --boxes: so many boxes of a frame, a pose for each; no memory."),
]
Mask = Annotated[
    Path | None,
    typer.Option(help="A mask of the target, not black there, or a folder with one a frame."),
]
At = Annotated[
    str | None,
    typer.Option(help="'x,y' or 'x,y,range', px and m: a place on the target in the first frame."),
]


def given_regions(
    sequence: Sequence, obj_id: int | None, box: str | None, boxes: Path | None,
    mask: Path | None, at: str | None, instances: int,
) -> tuple[Sequence, Where | None, npt.ArrayLike | None]:  # fmt: skip
    """The frames, each once for each instance, and where the target is in each and in the first.

    Raises:
        RendezviewError: more than one of the options is given, or one is wrong.
    """
    given = [
        name
        for name, value in (("--box", box), ("--boxes", boxes), ("--mask", mask), ("--at", at))
        if value is not None
    ]
    if len(given) > 1:
        raise RendezviewError(f"give one of {', '.join(given)}: each says where the target is")
    if instances > 1:
        if boxes is None:
            raise RendezviewError("--instances needs --boxes: where each of them is")
        return *each_box(boxes, sequence, obj_id, instances), None
    if boxes is not None:
        return sequence, boxes_by_frame(boxes, sequence, obj_id), None
    if mask is not None:
        return sequence, masks_by_frame(mask), None
    if box is not None:
        return sequence, None, numbers_of(box, "--box", (4,))
    return sequence, None, None if at is None else numbers_of(at, "--at", (2, 3))
