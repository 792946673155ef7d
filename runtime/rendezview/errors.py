"""The one base class of errors that a user can fix."""


class RendezviewError(Exception):
    """Something a user can put right: its message says what is wrong, where, and what to do."""
