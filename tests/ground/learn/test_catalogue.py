"""Catalogues: targets × shells × lighting, each model that of a training of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from rendezview.errors import RendezviewError
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.learn.catalogue import read_catalogue, train_catalogue
from rendezview_ground.learn.job import train
from rendezview_ground.learn.jobs.cores import Cores
from rendezview_ground.learn.jobs.shard_executor import ClusterError
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.mesh.symmetries import find_symmetries

CATALOGUE = """
[options]
order = 0
bins = 60
smooth_bins = 3
resolution_px = 64
perturbed_views = 40
held_out_views = 10
contour_points = 20
contour_resolution_px = 64
surface_points = 0

[[targets]]
target = "one.stl"
unit = "m"

[[targets]]
target = "flat.stl"
unit = "m"
options = { seed = 3 }

[[shells]]
name = "near"
contour_radii = [0.8, 1.0]

[[shells]]
name = "far"
contour_radii = [1.0]

[[lighting]]
name = "soft"
lit_views = false
"""


@pytest.fixture
def folder(tmp_path: Path, bumpy_mesh) -> Path:
    trimesh.Trimesh(bumpy_mesh.vertices_m, bumpy_mesh.faces).export(tmp_path / "one.stl")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "flat.stl")
    (tmp_path / "all.toml").write_text(CATALOGUE)
    return tmp_path


def test_a_catalogue_is_targets_times_shells_times_lighting(folder):
    entries = read_catalogue(folder / "all.toml")
    assert [e.name for e in entries] == [
        "one-near-soft",
        "one-far-soft",
        "flat-near-soft",
        "flat-far-soft",
    ]
    assert entries[0].options.contour_radii == (0.8, 1.0)
    assert not entries[0].options.shadowed_silhouettes  # `lit_views` is its old name in files
    assert [e.options.seed for e in entries] == [0, 0, 3, 3]


def test_the_old_name_of_an_option_means_the_new_one(folder):
    by_old = read_catalogue(folder / "all.toml")
    new = CATALOGUE.replace("lit_views", "shadowed_silhouettes")
    (folder / "new.toml").write_text(new)
    assert [e.options for e in read_catalogue(folder / "new.toml")] == [e.options for e in by_old]
    assert by_old[0].options.as_record()["lit_views"] is False  # as in models made before


def test_models_are_those_of_train_and_what_is_there_is_left(folder):
    """Two at once; what is made again, one after the other."""
    entries = read_catalogue(folder / "all.toml")
    reported: list[tuple[str, int, int]] = []
    outcome = train_catalogue(
        entries,
        folder / "models",
        Cores(1),
        at_once=2,
        progress=lambda *step: reported.append(step),
    )
    assert outcome.trained == ("one-near-soft", "one-far-soft")
    assert set(outcome.refused) == {"flat-near-soft", "flat-far-soft"}
    assert all("flat" in reason for reason in outcome.refused.values())
    assert ("models", 4, 4) in reported
    mesh = load_mesh(folder / "one.stl", "m")
    alone = folder / "alone.rvm"
    train(
        mesh,
        alone,
        name="one-near-soft",
        options=entries[0].options,
        symmetries=find_symmetries(mesh),
        jobs=1,
    )
    kept = folder / "models" / "one-near-soft.rvm"
    assert kept.read_bytes() == alone.read_bytes()
    damaged = folder / "models" / "one-far-soft.rvm"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:1000])
    again = train_catalogue(entries, folder / "models", Cores(1))
    assert again.there_already == ("one-near-soft",)
    assert again.trained == ("one-far-soft",)
    assert damaged.read_bytes() == whole
    assert len(ViewModel.load(kept).contours.shells_m) == 2


TARGET = """
name = "body"

[mesh]
path = "one.stl"
unit = "m"
shape_error = 0.01

[docking_ring]
centre_m = [0.0, 0.0, 1.0]
axis = [0.0, 0.0, 1.0]
radius_m = 0.5
"""


def test_models_have_all_that_the_target_file_says_and_follow_its_changes(folder):
    """A ring, how far the mesh is trusted: as those of `train`."""
    catalogue = CATALOGUE[: CATALOGUE.index("[[targets]]")] + '[[targets]]\ntarget = "body"\n'
    (folder / "body").mkdir()
    (folder / "one.stl").rename(folder / "body" / "one.stl")
    (folder / "all.toml").write_text(catalogue)
    for radius_m, stated in ((0.5, TARGET), (0.4, TARGET.replace("0.5", "0.4"))):
        (folder / "body" / "target.toml").write_text(stated)
        entries = read_catalogue(folder / "all.toml")
        outcome = train_catalogue(entries, folder / "models", Cores(1))
        assert outcome.trained == ("body",), outcome
        model = ViewModel.load(folder / "models" / "body.rvm")
        assert model.shape_error == 0.01
        assert model.docking_ring.radius_m == radius_m
    assert train_catalogue(entries, folder / "models", Cores(1)).there_already == ("body",)


def test_a_cluster_that_fails_stops_the_catalogue(folder):
    class Gone:
        def results(self, task, shared, arguments):
            raise ClusterError("the cluster is gone")
            yield

    with pytest.raises(ClusterError, match="gone"):
        train_catalogue(read_catalogue(folder / "all.toml"), folder / "models", Gone(), at_once=2)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("order = 0", "ordre = 0", "no training option ordre"),
        ("order = 0", "order = 77", "order = 77 is out of range"),
        ("order = 0", 'order = "many"', "order"),
        ('unit = "m"\n\n[[targets]]', 'units = "m"\n\n[[targets]]', "units"),
        ('name = "far"', 'name = "near"', "or names two"),
        ('name = "far"', 'name = "../far"', "not a valid name"),
        ("[[lighting]]", "[[lighting]", "not valid TOML"),
        ("[[targets]]", "[[goals]]", "goals|targets"),
    ],
)
def test_a_wrong_catalogue_is_refused_with_the_reason(folder, old, new, match):
    (folder / "all.toml").write_text(CATALOGUE.replace(old, new))
    with pytest.raises(RendezviewError, match=match):
        read_catalogue(folder / "all.toml")
    with pytest.raises(RendezviewError, match="no such"):
        read_catalogue(folder / "none.toml")
