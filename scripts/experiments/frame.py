"""What all experiments share."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]  # the checkout
MODELS_CAD = ROOT / "models_cad"
CLIENT = MODELS_CAD / "client"
PICTURES = ROOT / "docs" / "pictures"
