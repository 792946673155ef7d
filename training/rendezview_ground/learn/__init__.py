"""The ground stage: from a CAD model to a view model."""
