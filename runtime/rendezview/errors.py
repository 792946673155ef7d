"""The one base class of errors that a user can fix."""


class RendezviewError(Exception):
    """An error that a user can fix; its message names the fault, its place and the remedy."""


def without_cache(error: RuntimeError) -> RendezviewError | None:
    """numba's error where it can keep no compiled loops, in words; None for other errors."""
    if "no locator available" not in str(error):
        return None
    return RendezviewError(
        "neither the installed package nor the home folder can be written, where compiled loops "
        "are kept: set NUMBA_CACHE_DIR to a folder that can"
    )
