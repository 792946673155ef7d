"""Target files."""

import math

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.target import METRES_PER_UNIT, Target

MESH = '[mesh]\npath = "client.glb"\nunit = "m"\n'
FULL = """\
name = "client"
description = "one line"
[mesh]
path = "meshes/client.glb"
unit = "mm"
shape_error = 0.01
[docking_ring]
centre_m = [-1, 0.0, 0.25]
axis = [-2.0, 0.0, 0.0]
radius_m = 0.597
[[reflectors]]
name = "a"
group = "far"
position_m = [1.0, 2.0, 3.0]
normal = [0.0, 3.0, 4.0]
diameter_m = 0.05
[[reflectors]]
name = "b"
group = "near"
position_m = [1, 2, 4]
normal = [0, 0, 1]
diameter_m = 0.02
[[leds]]
name = "l"
position_m = [0, 0, 1]
normal = [0, 0, 1]
[[symmetries]]
kind = "discrete"
axis = [0, 0, 2]
angle_rad = 1.5707963267948966
[[symmetries]]
kind = "continuous"
axis = [1, 1, 0]
point_m = [0, 0, 0.002]
"""


def write(folder, text, mesh="client.glb"):
    (folder / mesh).parent.mkdir(exist_ok=True, parents=True)
    (folder / mesh).write_bytes(b"mesh")
    path = folder / "target.toml"
    path.write_text(text)
    return path


def test_every_field_is_read(tmp_path):
    path = write(tmp_path, FULL, "meshes/client.glb")
    target = Target.load(path)
    assert (target.name, target.description, target.unit) == ("client", "one line", "mm")
    assert target.mesh_path == tmp_path / "meshes" / "client.glb"
    assert target.shape_error == 0.01
    assert target.docking_ring.centre_m.tolist() == [-1.0, 0.0, 0.25]
    assert target.docking_ring.axis.tolist() == [-1.0, 0.0, 0.0]
    assert target.docking_ring.radius_m == 0.597
    first, second = target.reflectors
    assert (first.name, first.group, first.diameter_m) == ("a", "far", 0.05)
    assert first.position_m.tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(first.normal, [0.0, 0.6, 0.8], atol=1e-15)
    assert second.group == "near"
    assert target.leds[0].name == "l"
    discrete, continuous = target.symmetries
    assert (discrete.kind, discrete.angle_rad) == ("discrete", math.pi / 2)
    assert discrete.axis.tolist() == [0, 0, 1]
    assert discrete.point_m.tolist() == [0, 0, 0]  # none is given: the origin
    assert continuous.point_m.tolist() == [0, 0, 0.002]
    assert (continuous.kind, continuous.angle_rad) == ("continuous", None)
    np.testing.assert_allclose(continuous.axis, [math.sqrt(0.5), math.sqrt(0.5), 0])


def test_arrays_are_double_and_cannot_be_written_to(tmp_path):
    ring = Target.load(write(tmp_path, FULL, "meshes/client.glb")).docking_ring
    assert ring.axis.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        ring.axis[0] = 1.0


def test_a_folder_with_a_target_file_is_a_target(tmp_path):
    write(tmp_path, 'name = "x"\n' + MESH)
    target = Target.load(tmp_path)
    assert target.name == "x"
    assert target.docking_ring is None
    assert target.shape_error == 0.0
    assert target.reflectors == target.leds == target.symmetries == ()


def test_a_bare_mesh_is_a_target_of_unknown_unit(tmp_path):
    (tmp_path / "hubble.v2.stl").write_bytes(b"")
    target = Target.load(str(tmp_path / "hubble.v2.stl"))
    assert (target.name, target.unit) == ("hubble.v2", None)
    assert target.mesh_path == tmp_path / "hubble.v2.stl"


def test_units_are_exact():
    assert METRES_PER_UNIT == {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


RING = "[docking_ring]\ncentre_m = [0, 0, 0]\naxis = [0, 0, 1]\nradius_m = 1.0\n"
REFLECTOR = (
    '[[reflectors]]\nname = "a"\ngroup = "g"\nposition_m = [0, 0, 0]\nnormal = [0, 0, 1]\n'
    "diameter_m = 0.1\n"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MESH, "name: missing, add it"),
        ('name = ""\n' + MESH, "name: "),
        ('name = "x"\n', r"no \[mesh\], and no \[\[reflectors"),
        ('name = "x"\n[mesh]\npath = "client.glb"\n', r"mesh\.unit: missing"),
        ('name = "x"\n' + MESH.replace('"m"', '"km"'), r"mesh\.unit: .*'ft'"),
        ('name = "x"\ncolour = 1\n' + MESH, "colour: unknown key"),
        ('name = "x"\n' + MESH + "scale = 2\n", r"mesh\.scale: unknown key"),
        ('name = "x"\n' + MESH + RING + "depth = 1\n", r"docking_ring\.depth: unknown key"),
        ('name = "x"\n' + MESH + RING.replace("0, 1]", "0, 0]"), r"ring\.axis: a direction"),
        ('name = "x"\n' + MESH + RING.replace("0, 0, 1]", "0, 1]"), r"docking_ring\.axis"),
        ('name = "x"\n' + MESH + RING.replace("0, 0, 1]", "0, 0, nan]"), r"docking_ring\.axis\.2"),
        ('name = "x"\n' + MESH + RING.replace("1.0", "0.0"), r"docking_ring\.radius_m: .*greater"),
        ('name = "x"\n' + MESH + RING.replace("1.0", '"1"'), r"docking_ring\.radius_m"),
        ('name = "x"\n' + MESH + RING.replace("1.0", "true"), r"docking_ring\.radius_m"),
        ('name = "x"\n' + MESH + REFLECTOR + REFLECTOR, "reflectors: the name 'a' is used more"),
        (
            'name = "x"\n' + MESH + REFLECTOR.replace("diameter_m", "size_m"),
            r"reflectors\.0\.diameter_m: missing, add it; reflectors\.0\.size_m: unknown",
        ),
        ('name = "x"\n' + MESH + "shape_error = 0.5\n", r"mesh\.shape_error"),
        ('name = "x"\n' + MESH + '[[symmetries]]\nkind = "mirror"\n', r"symmetries\.0"),
        (
            'name = "x"\n' + MESH + '[[symmetries]]\nkind = "discrete"\naxis = [0, 0, 1]\n',
            "angle_rad: missing",
        ),
        (
            'name = "x"\n' + MESH
            + '[[symmetries]]\nkind = "continuous"\naxis = [0, 0, 1]\nangle_rad = 1.0\n',
            "angle_rad: unknown key",
        ),
        (
            'name = "x"\n' + MESH
            + '[[symmetries]]\nkind = "discrete"\naxis = [0, 0, 1]\nangle_rad = 90.0\n',
            "angle_rad: .*less than",
        ),
        (
            'name = "x"\n' + MESH
            + '[[symmetries]]\nkind = "discrete"\naxis = [0, 0, 1]\nangle_rad = 1.0\n',
            "symmetries: these symmetries never come round: angle_rad .*1.0.*: correct them",
        ),
        (
            'name = "x"\n' + MESH
            + '[[symmetries]]\nkind = "continuous"\naxis = [0, 0, 1]\npoint_m = [1, 0, 0]\n'
            + '[[symmetries]]\nkind = "discrete"\naxis = [0, 0, 1]\nangle_rad = 3.14159265\n',
            "symmetries: these axes have no common point, they miss it by 0.5 m",
        ),
        ('name = "x"\n' + MESH.replace("client.glb", "other.glb"), r"mesh\.path: .*other\.glb"),
        ("name = \n", "not valid TOML .*line 1"),
    ],
)  # fmt: skip
def test_a_wrong_target_file_names_the_file_and_the_key(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(RendezviewError, match=message) as caught:
        Target.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_what_is_not_there_is_named(tmp_path):
    with pytest.raises(RendezviewError, match=r"none\.toml: no such file"):
        Target.load(tmp_path / "none.toml")
    with pytest.raises(RendezviewError, match=r"none\.stl: no such file"):
        Target.load(tmp_path / "none.stl")
    with pytest.raises(RendezviewError, match=r"has no target\.toml"):
        Target.load(tmp_path)


def test_a_folder_of_results_does_not_hide_a_bundled_vehicle_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hubble").mkdir()
    assert find_target("hubble").name == "hubble"
    (tmp_path / "hubble" / "target.toml").write_text("wrong")
    with pytest.raises(RendezviewError):
        find_target("hubble")
