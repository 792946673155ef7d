"""Compiles the loops that the tests call, on all cores: ``python -m tests.compiled``."""

from rendezview.cli.compiling import GROUPS, compile_ahead


def compile_for_tests() -> None:
    """Nothing is done for loops that the cache on disk has."""
    compile_ahead(*GROUPS)


if __name__ == "__main__":
    compile_for_tests()
