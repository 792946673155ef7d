"""The models of the service: files in one folder, and one from the command line."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import re
import secrets
import threading
from functools import cached_property
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.io.files import make_folder, write_error
from rendezview.sensors.appearance import ViewModel
from rendezview.service.model_geometry import geometry
from rendezview.service.model_messages import ModelInfo

log = logging.getLogger("rendezview.service")

SUFFIX = ".rvm"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class StoredModel:
    """One model file, read on first use, by whichever thread is first."""

    def __init__(self, name: str, path: Path, own: bool, model: ViewModel | None = None) -> None:
        self.name = name
        self.path = path
        self.own = own  # in the store's folder: may be deleted
        self._model = model
        self._lock = threading.Lock()

    @property
    def model(self) -> ViewModel:
        """The model.

        Raises:
            RendezviewError: the file is not a model, or is gone.
        """
        with self._lock:
            if self._model is None:
                self._model = ViewModel.load(self.path)
            return self._model

    @cached_property
    def info(self) -> ModelInfo:
        """The model as a message."""
        return ModelInfo(
            name=self.name,
            target=self.model.name,
            sha256=hashlib.sha256(self.path.read_bytes()).hexdigest(),
            size_bytes=self.path.stat().st_size,
            order=self.model.order,
            nodes=len(self.model.geodesic.nodes),
            target_radius_m=self.model.target_radius_m,
            sphere_radius_m=self.model.sphere_radius_m,
            refines=self.model.contours is not None,
            loaded=True,
        )

    @cached_property
    def geometry_json(self) -> bytes:
        """The `Geometry` message, JSON."""
        return geometry(self.name, self.model).model_dump_json().encode()


class ModelStore:
    """Models by name. Uploads may come from several threads."""

    def __init__(self, folder: Path) -> None:
        """The models in a folder.

        Raises:
            RendezviewError: the folder cannot be made.
        """
        make_folder(folder)
        self.folder = folder
        self._models: dict[str, StoredModel] = {}
        self._lock = threading.Lock()  # of a name's check and its insertion
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            if _NAME.fullmatch(path.stem) and path.is_file():
                self._models[path.stem] = StoredModel(path.stem, path.resolve(), own=True)

    def give(self, path: Path) -> StoredModel:
        """Add a model file from elsewhere under its file name; it is read at once.

        Raises:
            RendezviewError: it is not a model.
        """
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", path.stem).strip("-_")[:64] or "model"
        stored = StoredModel(name, path.resolve(), own=False)
        _ = stored.model
        self._models[name] = stored
        return stored

    def __len__(self) -> int:
        return len(self._models)

    def names(self) -> list[str]:
        """Names, sorted."""
        return sorted(self._models)

    def get(self, name: str) -> StoredModel | None:
        """A model by name."""
        return self._models.get(name)

    def only(self) -> StoredModel | None:
        """The model, if there is exactly one."""
        return next(iter(self._models.values())) if len(self._models) == 1 else None

    def first_readable(self) -> StoredModel | None:
        """The first model whose file can be read; the log has the errors of the others."""
        for name in self.names():
            try:
                ViewModel.load(self._models[name].path)
            except RendezviewError as error:
                log.warning("model not read", extra={"model": name, "reason": str(error)})
            else:
                return self._models[name]
        return None

    def path_for(self, name: str) -> Path:
        """The file of a new model.

        Raises:
            RendezviewError: the name is invalid or taken.
        """
        if not _NAME.fullmatch(name):
            raise RendezviewError(f"model name {name[:80]!r}: use letters, digits, - and _")
        if name in self._models:
            raise RendezviewError(f"model {name}: there is one already: choose another name")
        return self.folder / f"{name}{SUFFIX}"

    def add(self, name: str, content: bytes) -> StoredModel:
        """Store an uploaded model after it is read and checked.

        Raises:
            RendezviewError: the name is invalid or taken, or the content is not a model.
        """
        path = self.path_for(name)
        trial = self.folder / f".{secrets.token_hex(8)}.tmp"
        try:
            trial.write_bytes(content)
            try:
                model = ViewModel.load(trial)
            except RendezviewError as error:
                raise RendezviewError(str(error).replace(str(trial), "the model sent")) from None
            with self._lock:
                self.path_for(name)  # another upload may have taken the name meanwhile
                trial.replace(path)
                stored = StoredModel(name, path.resolve(), own=True, model=model)
                self._models[name] = stored
        except OSError as error:
            raise write_error(path, error) from None
        finally:
            with contextlib.suppress(OSError):
                trial.unlink()
        return stored

    def found(self, name: str) -> StoredModel:
        """Add a file that a training job has put into the folder."""
        stored = StoredModel(name, (self.folder / f"{name}{SUFFIX}").resolve(), own=True)
        _ = stored.model
        self._models[name] = stored
        return stored

    def remove(self, name: str) -> None:
        """Remove a model and delete its file.

        Raises:
            RendezviewError: it was given on the command line.
        """
        stored = self._models[name]
        if not stored.own:
            raise RendezviewError(f"model {name}: was given on the command line and stays")
        with contextlib.suppress(FileNotFoundError):
            stored.path.unlink()
        del self._models[name]
