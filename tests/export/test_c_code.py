"""Exported flight code: it compiles as strict C99, and says what the runtime says, bit for bit."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.export.driver import (
    MORE_WARNINGS,
    SANITIZED,
    STRICT,
    ActiveNodes,
    FlightCode,
    build,
    compiler,
    object_bytes,
    runtime_search,
    runtime_search_around,
    same_search,
)

from rendezview.errors import RendezviewError
from rendezview.export import write_c
from rendezview.export.c_code import model_files
from rendezview.export.tables import pack_forest
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.model.trees import Forest
from rendezview.sensors.appearance.outline.silhouette import Missing, find_silhouette, outer_borders
from rendezview.sensors.appearance.outline.tracing import crack_outline
from rendezview.sensors.appearance.outline.votes import Matcher
from rendezview.sensors.observation import Status

SIGNATURES = 10_000
needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


@pytest.fixture(scope="module")
def code(tmp_path_factory: pytest.TempPathFactory, tiny_model: ViewModel) -> Iterator[FlightCode]:
    """The tiny model's flight code, which ends at once where it oversteps memory or numbers."""
    if compiler() is None:
        pytest.skip("there is no C compiler here")
    folder = tmp_path_factory.mktemp("flight") / "code"
    with FlightCode(build(tiny_model, folder, SANITIZED), tiny_model) as running:
        yield running


def some_readings(model: ViewModel, rng: np.random.Generator) -> np.ndarray:
    view = model.views.readings[rng.integers(len(model.views.readings))]
    noise = 1.0 + rng.uniform(0.0, 0.1) * rng.normal(size=model.bins)
    return np.rint(np.maximum(view * noise, 0.0)).astype(np.float32)


def some_attitude(model: ViewModel, rng: np.random.Generator) -> np.ndarray:
    view = model.views.centred_from_target[rng.integers(len(model.views.readings))]
    return Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix() @ view


@pytest.mark.requirement("RV-CODE-1")
@needs_compiler
@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_it_compiles_without_a_warning(forest_model, tmp_path, level):
    build(forest_model, tmp_path / "code", [level, *MORE_WARNINGS])


@pytest.mark.requirement("RV-CODE-1")
@needs_compiler
def test_all_trees_decide_as_the_runtime_on_ten_thousand_signatures(code, tiny_model):
    rng = np.random.default_rng(1)
    forest, matcher = tiny_model.forest, Matcher(tiny_model)
    nodes = np.arange(len(forest))
    bins = tiny_model.bins
    on = 0
    for k in range(SIGNATURES):
        readings = some_readings(tiny_model, rng)
        rolls = rng.uniform(-np.pi, np.pi, len(nodes))
        if k % 10 == 0:  # whole and half bins, where rounding decides
            rolls = np.pi / bins * rng.integers(-bins, bins + 1, len(nodes))
        trust = matcher.trust_of(forest.leaves(readings, nodes, rolls))
        assert np.array_equal(code.trees(readings, rolls), trust)
        on += np.count_nonzero(trust)
    assert on > SIGNATURES  # it was not all off


@needs_compiler
def test_the_search_finds_the_on_nodes_of_the_runtime_and_their_direction(code, tiny_model):
    rng = np.random.default_rng(2)
    matcher, usual = Matcher(tiny_model), 3.2 * tiny_model.geodesic.mean_edge_rad
    found = 0
    for k in range(300):
        readings, attitude = some_readings(tiny_model, rng), some_attitude(tiny_model, rng)
        reach = [usual, 0.0, np.pi, 10.0][k % 4]
        python = runtime_search(matcher, readings, attitude, reach)
        c = code.search(readings, attitude, reach)
        assert same_search(c, python)
        if python is not None:
            assert isinstance(c, ActiveNodes)
            assert c.support == pytest.approx(c.weights.sum())
            found += 1
    assert found > 100


@needs_compiler
def test_the_search_around_an_attitude_takes_the_roll_of_best_agreement(code, tiny_model):
    rng = np.random.default_rng(8)
    matcher = Matcher(tiny_model)
    found = 0
    for error in np.repeat([0.0, 0.01, 0.35, 1.0, np.pi], 12):
        readings, attitude = some_readings(tiny_model, rng), some_attitude(tiny_model, rng)
        python = runtime_search_around(matcher, readings, attitude, error)
        assert same_search(code.search_around(readings, attitude, error), python)
        found += python is not None
    assert found > 30
    for error in (-0.1, 3.2, np.nan):
        assert code.search_around(readings, attitude, error) == "bad input"


def compare(code: FlightCode, image: np.ndarray, camera: Camera, expected=None) -> bool:
    """Whether there is a silhouette; C and Python must say the same of it."""
    python = find_silhouette(image, expected_px=expected)
    c = code.frame(image, camera, expected)
    if isinstance(python, Missing):
        assert c == python.status
        return False
    assert isinstance(c, tuple), c
    outline, signature = c
    assert len(outline.outlines_px) == len(python.outlines_px)
    assert all(map(np.array_equal, outline.outlines_px, python.outlines_px))
    assert outline.box_px == python.box_px
    assert (outline.area_px, outline.sky_grey, outline.level_grey) == (
        python.area_px,
        python.sky_grey,
        python.level_grey,
    )
    rays = [camera.rays(points) for points in python.outlines_px]
    expected_signature = Signature.of_outlines(rays, code.bins, 5)
    if expected_signature is None:
        assert signature is Status.SMALL
    else:
        assert isinstance(signature, Signature)
        assert_same(signature, expected_signature)
    return True


def assert_same(c: Signature, python: Signature) -> None:
    assert np.array_equal(c.readings, python.readings)
    assert c.area_sr == pytest.approx(python.area_sr, rel=1e-14)
    assert np.allclose(c.centred_from_camera, python.centred_from_camera, rtol=0.0, atol=1e-14)


def test_a_frame_gives_the_outline_and_the_signature_of_the_runtime(code, bumpy_mesh, camera, draw):
    rng = np.random.default_rng(3)
    for _ in range(12):
        rotation = Rotation.random(random_state=rng).as_matrix()
        pose = Pose(rotation, np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(8.0, 25.0)]))
        assert compare(code, draw(bumpy_mesh, pose, camera, rng), camera)


def test_frames_of_random_blobs_give_the_outlines_of_the_runtime(code):
    """Holes, islands in holes, single pixels, parts to join, rivals, touches of the border."""
    rng = np.random.default_rng(4)
    seen: dict[bool, int] = {True: 0, False: 0}
    for k in range(400):
        height, width = rng.integers(8, 90, 2)
        field = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), rng.uniform(0.6, 6.0))
        field = field > rng.uniform(-0.5, 2.5) * field.std()
        if k % 2:
            rim = rng.integers(1, 4)
            field[:rim], field[-rim:], field[:, :rim], field[:, -rim:] = 0, 0, 0, 0
        grey = 12.0 + 120.0 * field + rng.uniform(0.0, 3.0) * rng.normal(size=field.shape)
        image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        camera = Camera(int(width), int(height), 80.0, 90.0, width / 2.0, height / 2.0)
        expected = rng.uniform(0.0, (width, height)) if k % 3 == 0 else None
        seen[compare(code, image, camera, expected)] += 1
    assert min(seen.values()) > 50


@pytest.mark.parametrize(
    ("grey", "status"),
    [(0, Status.EMPTY), (9, Status.EMPTY), (140, Status.FULL), (255, Status.FULL)],
)
def test_a_frame_without_a_target_is_told(code, grey, status):
    image = np.full((40, 50), grey, dtype=np.uint8)
    assert code.frame(image, Camera.from_fov(50, 40, 0.5)) is status
    assert find_silhouette(image).status is status


def test_a_sky_full_of_specks_does_not_hide_the_target(code):
    rng = np.random.default_rng(5)
    image = np.full((300, 300), 3, dtype=np.uint8)
    for place in rng.choice(49 * 49, 900, replace=False):
        x, y = 3 + 6 * (place % 49), 3 + 6 * (place // 49)
        image[y : y + 3, x : x + 3] = 8  # above the level in the middle pixel only
    cv2.circle(image, (150, 150), 60, 180, -1)
    mean = cv2.blur(image, (3, 3))
    assert len(outer_borders((mean > 7).astype(np.uint8))) > 600
    assert compare(code, image, Camera.from_fov(300, 300, 0.5))


def test_parts_of_a_body_beyond_what_there_is_room_for_are_told(code):
    image = np.full((200, 200), 3, dtype=np.uint8)
    image[4:196:6, 4:196:6] = 200  # nothing but specks, none larger than the others
    assert code.frame(image, Camera.from_fov(200, 200, 0.5)) == "no room"
    image[:] = 3
    image[50:150, 50:150] = 200
    assert code.frame(image, Camera.from_fov(200, 200, 0.5), most_points=100) == "no room"


def test_signatures_of_any_outlines_are_those_of_the_runtime(code, tiny_model):
    rng = np.random.default_rng(6)
    for k in range(300):
        outlines = []
        for _ in range(rng.integers(1, 4)):
            tangled = rng.normal(0.0, 10.0 ** rng.uniform(-4.0, 0.3), (rng.integers(0, 60), 2))
            shifted = tangled + rng.normal(0.0, 0.5, 2)
            outlines.append(np.column_stack([shifted, np.ones(len(shifted))]))
        if k % 5 == 0:  # pixels of a drawn mask: many points in line, corners on the bins' rays
            mask = np.zeros((40, 40), dtype=np.uint8)
            cv2.rectangle(mask, (8, 9), tuple(rng.integers(12, 35, 2).tolist()), 255, -1)
            none = np.zeros((0, 0), dtype=np.uint8)
            points = [crack_outline(b, none, 0.0, 0.0, 0) for b in outer_borders(mask)]
            outlines = [Camera(40, 40, 50.0, 50.0, 19.5, 19.5).rays(p) for p in points]
        python = Signature.of_outlines(outlines, tiny_model.bins, tiny_model.smooth_bins)
        c = code.signature(outlines)
        if python is None:
            assert c is Status.SMALL
        else:
            assert isinstance(c, Signature)
            assert_same(c, python)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_numbers_that_are_none_are_refused(code, tiny_model, bad):
    triangle = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, bad]])
    assert code.signature([triangle]) == "bad input"
    readings, rolls = some_readings(tiny_model, np.random.default_rng(7)), np.zeros(code.node_count)
    rolls[3] = bad
    assert code.trees(readings, rolls) == "bad input"
    attitude = np.eye(3)
    attitude[1, 2] = bad
    assert code.search(readings, attitude, 0.5) == "bad input"
    assert code.search(readings, np.eye(3), np.nan) == "bad input"


def test_outlines_that_enclose_nothing_have_no_signature(code):
    assert code.signature([]) is Status.SMALL
    assert code.signature([np.array([[0.0, 0.0], [0.1, 0.0]])]) is Status.SMALL


def test_a_frame_too_small_or_too_large_is_refused(code):
    assert code.frame(np.zeros((7, 20), dtype=np.uint8), Camera.from_fov(20, 7, 0.5)) == "bad input"


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory, forest_model: ViewModel) -> Path:
    """Folder of object files, compiled as for flight."""
    if compiler() is None or shutil.which("size") is None or shutil.which("nm") is None:
        pytest.skip("there is no C compiler here, or no size or nm")
    folder = tmp_path_factory.mktemp("objects") / "code"
    object_bytes(forest_model, folder)
    return folder


def test_the_header_tells_the_size_of_the_tables(objects):
    told = re.search(r"RDV_TABLE_BYTES (\d+)u", (objects / "rendezview_model.h").read_text())
    assert told is not None
    said = subprocess.run(
        ["size", objects / "rendezview_model.o"], capture_output=True, text=True, check=True
    )
    taken = int(said.stdout.splitlines()[1].split()[3])
    assert int(told[1]) <= taken < int(told[1]) + 400  # what holds the file together


def test_nothing_is_called_but_mathematics(objects):
    paths = sorted(objects.glob("*.o"))
    said = subprocess.run(["nm", "-u", *paths], capture_output=True, text=True, check=True).stdout
    called = set(re.findall(r"U (\w+)", said))
    mathematics = {"atan2", "ceil", "cos", "exp", "floor", "fmax", "fmin", "hypot", "rint", "sin"}
    mathematics |= {"sincos", "sqrt"}
    by_the_compiler = {"memcpy", "memset", "memmove", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}
    assert "atan2" in called
    assert {c for c in called if not c.startswith("rdv_")} <= mathematics | by_the_compiler


def test_every_table_is_constant(objects):
    for path in objects.glob("*.o"):
        said = subprocess.run(["size", path], capture_output=True, text=True, check=True).stdout
        assert said.splitlines()[1].split()[1:3] == ["0", "0"]  # data, bss


@pytest.mark.requirement("RV-CODE-1")
def test_no_function_calls_itself(objects):
    """Each function calls only those above it in its file, or of the files before."""
    functions = 0
    for path in objects.glob("*.c"):
        text = re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
        bodies = re.split(r"\n(?=[a-z][\w ]*[ *]\w+\([^;{]*\)\n\{)", text)[1:]
        for k, body in enumerate(bodies):
            head = re.match(r"[\w ]*[ *](\w+)\(", body)
            assert head is not None
            functions += 1
            for later in bodies[:k]:
                assert not re.search(rf"\b{head[1]}\(", later), (path.name, head[1])
            assert len(re.findall(rf"\b{head[1]}\(", body)) == 1, (path.name, head[1])
    assert functions > 40


def test_the_example_of_the_readme_compiles(objects, tmp_path):
    blocks = re.findall(r"```c\n(.*?)```", (objects / "README.md").read_text(), flags=re.DOTALL)
    assert len(blocks) == 1
    (tmp_path / "example.c").write_text(blocks[0])
    command = [compiler(), *STRICT, f"-I{objects}", "-c", "example.c", "-o", "example.o"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def forest_of(rows: list[tuple[int, float, int, int, int]], roots: list[int]) -> Forest:
    component, threshold, left, right, category = zip(*rows, strict=True)
    return Forest(
        np.array(roots, dtype=np.int32),
        np.array(component, dtype=np.int16),
        np.array(threshold, dtype=np.float32),
        np.array(left, dtype=np.int32),
        np.array(right, dtype=np.int32),
        np.array(category, dtype=np.uint8),
    )


def with_forest(model: ViewModel, forest: Forest) -> ViewModel:
    samples = np.arange(len(forest.component), dtype=np.int32)
    return replace(model, forest=forest, leaf_on=samples + 1, leaf_off=samples[::-1].copy())


@needs_compiler
def test_trees_of_one_leaf_and_thresholds_with_a_fraction_decide_as_the_runtime(
    tiny_model, tmp_path
):
    trees = len(tiny_model.forest)
    rows: list[tuple[int, float, int, int, int]] = [(-1, 0.0, 0, 0, 1), (-1, 0.0, 0, 0, 0)]
    roots = [k % 2 for k in range(trees - 2)]
    roots.append(len(rows))
    rows += [(3, 499.75, 3, 4, 0), (-1, 0.0, 0, 0, 1), (-1, 0.0, 0, 0, 0)]
    roots.append(len(rows))
    rows += [(119, 0.0, 6, 7, 0), (-1, 0.0, 0, 0, 0), (-1, 0.0, 0, 0, 1)]
    model = with_forest(tiny_model, forest_of(rows, roots))
    matcher, nodes = Matcher(model), np.arange(trees)
    with FlightCode(build(model, tmp_path / "code", SANITIZED), model) as code:
        for value in (0, 1, 499, 500):
            readings = np.full(model.bins, value, dtype=np.float32)
            trust = matcher.trust_of(model.forest.leaves(readings, nodes, np.zeros(trees)))
            assert np.array_equal(code.trees(readings, np.zeros(trees)), trust)


def test_a_tree_with_many_leaves_takes_wider_tables(tiny_model):
    rows: list[tuple[int, float, int, int, int]] = []
    for k in range(450):  # a chain of branches with a leaf on the left of each
        rows += [(k % 100, float(k), 2 * k + 1, 2 * k + 2, 0), (-1, 0.0, 0, 0, 1)]
    rows.append((-1, 0.0, 0, 0, 0))
    model = with_forest(tiny_model, forest_of(rows, [0] * len(tiny_model.forest)))
    header = model_files(model)[0]
    assert "typedef uint16_t rdv_child;" in header
    assert "typedef uint32_t rdv_index;" in header
    assert pack_forest(model).depths.max() == 450


@pytest.mark.parametrize("threshold", [-1.0, 65536.0, np.inf])
def test_a_threshold_that_does_not_fit_is_told(tiny_model, threshold):
    rows = [(0, threshold, 1, 2, 0), (-1, 0.0, 0, 0, 1), (-1, 0.0, 0, 0, 0)]
    model = with_forest(tiny_model, forest_of(rows, [0] * len(tiny_model.forest)))
    with pytest.raises(RendezviewError, match="threshold"):
        pack_forest(model)


def test_the_same_model_gives_the_same_files(tiny_model, tmp_path):
    first, second = write_c(tiny_model, tmp_path / "a"), write_c(tiny_model, tmp_path / "b")
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    assert {p.name for p in first} == {p.name for p in (tmp_path / "a").iterdir()}


def test_a_name_cannot_leave_its_comment(tiny_model):
    for text in model_files(replace(tiny_model, name="*/ int main; /*\n#error")):
        assert "int main; " not in text
        assert text.splitlines()[0].startswith("/* ")
        assert "\n#error" not in text


def test_every_line_fits_a_terminal(tiny_model, tmp_path: Path):
    for path in write_c(tiny_model, tmp_path / "code"):
        assert max(map(len, path.read_text().splitlines()), default=0) <= 100, path
