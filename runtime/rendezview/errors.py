"""The one base class of errors that a user can fix."""


class RendezviewError(Exception):
    """An error that a user can fix; its message names the fault, its place and the remedy."""
