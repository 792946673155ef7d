"""The one base class of errors that a user can fix."""

import contextlib
import re
from collections.abc import Iterator

# Numbers and words that no message needs whole. Source: two float64; a file name and its colon
_LONG = re.compile(r"\d{41,}|[^\s/]{257,}")


class RendezviewError(Exception):
    """An error that a user can fix; its message names the fault, its place and the remedy.

    A value of hundreds of characters that the message quotes is shortened.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_LONG.sub(lambda m: f"{m[0][:20]}… ({len(m[0])} characters)", message))


def without_cache(error: RuntimeError) -> RendezviewError | None:
    """numba's error where it can keep no compiled loops, in words; None for other errors."""
    if "no locator available" not in str(error):
        return None
    return RendezviewError(
        "neither the installed package nor the home folder can be written, where compiled loops "
        "are kept: set NUMBA_CACHE_DIR to a folder that can"
    )


@contextlib.contextmanager
def explained(
    before: str, after: str = "", faults: type[Exception] | tuple[type[Exception], ...] = ValueError
) -> Iterator[None]:
    """Raise an error of the work inside again with words before it (the place) and after it.

    Raises:
        RendezviewError: the work inside failed with one of the ``faults``.
    """
    try:
        yield
    except faults as error:
        raise RendezviewError(f"{before}{error}{after}") from error


@contextlib.contextmanager
def optional(who: str, extra: str, said: str = "", instead: str = "") -> Iterator[None]:
    """Say how to install the package that an import misses; ``who`` needs it.

    ``instead``: another way out.

    Raises:
        RendezviewError: it is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("rendezview"):
            raise
        raise RendezviewError(
            f"{who} {error.name}{said}: pip install 'rendezview[{extra}]'{instead}"
        ) from None
