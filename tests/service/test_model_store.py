"""The models of a service."""

from __future__ import annotations

import gc
import shutil
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview_service.hub.model_store import ModelStore, StoredModel


def test_of_uploads_with_one_name_at_once_one_is_kept(model_path, tmp_path):
    store = ModelStore(tmp_path)
    refusals = []

    def add(number: int) -> StoredModel | None:
        sent = Path(shutil.copy(model_path, tmp_path / f".{number}.tmp"))
        try:
            return store.add("same", sent)
        except RendezviewError as error:
            refusals.append(str(error))
            sent.unlink()
            return None

    with ThreadPoolExecutor(8) as threads:
        kept = [stored for stored in threads.map(add, range(8)) if stored is not None]
    assert [store.get("same")] == kept
    assert len(refusals) == 7
    assert all("there is one already" in refusal for refusal in refusals)
    assert [path.name for path in tmp_path.iterdir()] == ["same.rvm"]


def test_a_copy_that_a_cleaner_removes_is_made_again(model_path, tmp_path):
    folder = tmp_path / "copies"
    folder.mkdir()
    path = tmp_path / "sent.rvm"
    path.write_bytes(model_path.read_bytes())
    stored = StoredModel("sent", path, True, folder)
    copy = stored.copy
    path.unlink()  # replaced meanwhile: the copy is the only one
    shutil.rmtree(folder)
    assert stored.copy == copy
    assert copy.read_bytes() == model_path.read_bytes()


def test_threads_share_one_model(model_path, tmp_path):
    stored = StoredModel("bumpy", model_path, False, tmp_path)
    with ThreadPoolExecutor(8) as threads:
        models = list(threads.map(lambda _: stored.model, range(8)))
    assert all(model is models[0] for model in models)


def test_a_model_whose_name_is_gone_leaves_memory_too(model_path, tmp_path, monkeypatch):
    monkeypatch.setattr("rendezview_service.hub.model_store._REST_S", 0.0)
    store = ModelStore(tmp_path / "models", tmp_path)
    stored = store.add("gone", Path(shutil.copy(model_path, tmp_path / "sent.tmp")))
    store.remove("gone")
    content = weakref.ref(stored.model.views.readings.base)
    store.rest([stored])  # a session has it still
    gc.collect()
    assert content() is None
    assert stored.copy.exists()


def test_a_model_that_nobody_asks_for_leaves_memory_and_its_facts_stay(
    model_path, tmp_path, monkeypatch
):
    store = ModelStore(None, tmp_path)
    stored = store.give(model_path)
    # The arrays of a model are views of its file's content.
    content = weakref.ref(stored.model.views.readings.base)
    store.rest()
    assert content() is not None  # just used
    monkeypatch.setattr("rendezview_service.hub.model_store._REST_S", 0.0)
    store.rest()
    gc.collect()
    assert content() is None
    assert stored.info.nodes > 0
    assert stored.known == (None, ())
    assert stored.centre_m.shape == (3,)
    assert stored.model.name == stored.info.target  # read again
