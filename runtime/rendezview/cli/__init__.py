"""The ``rendezview`` command."""
