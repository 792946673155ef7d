"""The models of the service: files in one folder, and one from the command line.

A model is what its content is: it is copied to a file named by its hash when it is first used, and
workers read that copy. A file that changes afterwards, or another model under the same name, does
not change the model of a session.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import re
import secrets
import shutil
import threading
import time
import weakref
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.files import atomic_write, make_folder, write_error
from rendezview.io.target import DockingRing, Reflector
from rendezview.sensors.appearance import ViewModel
from rendezview_service.logs.log_lock import TemporaryFolder
from rendezview_service.messages.model_messages import ModelInfo
from rendezview_service.tracker.model_geometry import geometry

log = logging.getLogger("rendezview_service")

SUFFIX = ".rvm"
BY_HASH = "by-hash"  # folder of copies that several services share
_PIECE = 1_000_000  # bytes of a file that are in memory at once. Source: chosen
_REST_S = 30.0  # s without use, until a model's memory is given back. Source: chosen
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class NameTaken(RendezviewError):
    """A model has this name already."""


class StoredModel:
    """One model file, read on first use, by whichever thread is first."""

    def __init__(self, name: str, path: Path, own: bool, copies: Path) -> None:
        """A model that is not read yet.

        Args:
            own: the file is in the store's folder, and may be deleted.
            copies: folder of the files named by their hash.
        """
        self.name = name
        self.path = path
        self.own = own
        self._copies = copies
        self._copy: Path | None = None
        self._held: int | None = None  # descriptor of its copy, which reads without a name, too
        self._model: ViewModel | None = None  # None: not in memory
        self._used_s = 0.0
        self._lock = threading.RLock()

    @property
    def is_read(self) -> bool:
        """Whether it has been used."""
        return self._copy is not None

    @property
    def model(self) -> ViewModel:
        """The model, in memory until `rest`. Errors as in `copy`."""
        with self._lock:
            self._used_s = time.monotonic()
            if self._copy is None:
                self._model = self._checked()
                _ = self.info, self.centre_m, self.known  # sessions open without the model
            elif self._model is None:
                self._model = ViewModel.load(self.copy)
            return self._model

    def rest(self) -> None:
        """Give back the memory of a model that nobody has asked for: workers have their own."""
        with self._lock:
            if time.monotonic() - self._used_s > _REST_S:
                self._model = None

    @property
    def copy(self) -> Path:
        """The copy of its file that is named by its hash; made again if a cleaner removed it.

        Raises:
            RendezviewError: the file is not a model, or is gone.
        """
        copy = self._named()
        if self._held is not None and not copy.exists():
            make_folder(copy.parent)
            content = os.pread(self._held, os.fstat(self._held).st_size, 0)
            with atomic_write(copy, durable=False) as file:
                file.write(content)
            log.warning("a model's copy was removed, and is made again", extra={"copy": str(copy)})
        return copy

    @property
    def sha256(self) -> str:
        """The hash of its content, hexadecimal. Errors as in `copy`, on first use only."""
        return self._named().stem

    def _named(self) -> Path:
        """Where its copy is, or was; it is read first if it has not been."""
        if self._copy is None:
            _ = self.model
        assert self._copy is not None
        return self._copy

    def _checked(self) -> ViewModel:
        """Copy the file and read the copy."""
        copy = self._copied()
        try:
            model = ViewModel.load(copy)
        except RendezviewError as error:
            copy.unlink()
            said = str(error).replace(str(copy), str(self.path))
            raise RendezviewError(said) from None
        self._held, self._copy = os.open(copy, os.O_RDONLY), copy
        weakref.finalize(self, os.close, self._held)
        return model

    def _copied(self) -> Path:
        """Copy the file, in pieces, under its hash."""
        part, checksum = self._copies / f".{secrets.token_hex(6)}.tmp", hashlib.sha256()
        try:
            with open(self.path, "rb") as source, open(part, "xb") as file:
                while piece := source.read(_PIECE):
                    checksum.update(piece)
                    file.write(piece)
            return part.rename(self._copies / f"{checksum.hexdigest()}{SUFFIX}")
        except OSError as error:
            ViewModel.load(self.path)  # says what is wrong, if it is that file
            raise write_error(self._copies, error) from error
        finally:
            part.unlink(missing_ok=True)

    @cached_property
    def info(self) -> ModelInfo:
        """The model as a message."""
        return ModelInfo(
            name=self.name,
            target=self.model.name,
            sha256=self.sha256,
            size_bytes=self.copy.stat().st_size,
            order=self.model.order,
            nodes=len(self.model.geodesic.nodes),
            target_radius_m=self.model.target_radius_m,
            sphere_radius_m=self.model.sphere_radius_m,
            refines=self.model.contours is not None,
            loaded=True,
        )

    @cached_property
    def centre_m(self) -> Array:
        """(3,) m, target frame: the middle of its views."""
        return self.model.centre_m.copy()  # a view of it would keep the whole file in memory

    @cached_property
    def known(self) -> tuple[DockingRing | None, tuple[Reflector, ...]]:
        """The target's ring and reflectors."""
        return self.model.docking_ring, self.model.reflectors

    @cached_property
    def geometry_json(self) -> bytes:
        """The `Geometry` message, JSON."""
        return geometry(self.name, self.model).model_dump_json().encode()


class ModelStore:
    """Models by name. Uploads may come from several threads."""

    def __init__(
        self, folder: Path | None, state: Path | None = None, *, shared: bool = False
    ) -> None:
        """The models in a folder; None: a temporary one.

        Args:
            state: folder of the one with the files named by their hash; None: a temporary one.
            shared: several services share it, and nobody empties it.

        Raises:
            RendezviewError: the folder cannot be made.
        """
        self._temporary: list[TemporaryFolder] = []  # they live as long as the store
        self.folder = self._made(folder)
        self._copies = self._made(None if state is None else state / BY_HASH)
        self._shared = shared
        self._models: dict[str, StoredModel] = {}
        self._lock = threading.Lock()  # of a name's check and its insertion
        for path in sorted(self.folder.glob(f"*{SUFFIX}")):
            if _NAME.fullmatch(path.stem) and path.is_file():
                self._models[path.stem] = self._stored(path.stem, path, own=True)

    def _made(self, folder: Path | None) -> Path:
        if folder is None:
            self._temporary.append(TemporaryFolder("rendezview-models-"))
            folder = self._temporary[-1].path
        make_folder(folder)
        return folder

    def _stored(self, name: str, path: Path, own: bool) -> StoredModel:
        return StoredModel(name, path.resolve(), own, self._copies)

    def know(self, name: str, copy: Path) -> StoredModel:
        """A model that another service has stored, by its file named by its hash."""
        stored = self._models.get(name)
        if stored is None or not stored.is_read or stored.copy != copy:
            stored = self._models[name] = StoredModel(name, copy, False, copy.parent)
        return stored

    def kept(self, name: str, sha256: str) -> StoredModel:
        """A model of a session of before, perhaps not the one that has its name now."""
        named = self._models.get(name)
        if named is not None and named.is_read and named.sha256 == sha256:
            return named
        return self._stored(name, self._copies / f"{sha256}{SUFFIX}", own=False)

    def give(self, path: Path) -> StoredModel:
        """Add a model file from elsewhere under its file name; it is read at once.

        Raises:
            RendezviewError: it is not a model.
        """
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", path.stem).strip("-_")[:64] or "model"
        stored = self._stored(name, path, own=False)
        _ = stored.model
        self._models[name] = stored
        return stored

    def all(self) -> list[StoredModel]:
        """In order of their names."""
        return [self._models[name] for name in sorted(self._models)]

    def get(self, name: str) -> StoredModel | None:
        """A model by name."""
        return self._models.get(name)

    def only(self) -> StoredModel | None:
        """The model, if there is exactly one."""
        return next(iter(self._models.values())) if len(self._models) == 1 else None

    def first_readable(self) -> StoredModel | None:
        """The first model whose file can be read; the log has the errors of the others."""
        for stored in self.all():
            try:
                _ = stored.model
            except RendezviewError as error:
                log.warning("model not read", extra={"model": stored.name, "reason": str(error)})
            else:
                return stored
        return None

    def path_for(self, name: str, replace: bool = False) -> Path:
        """The file of a new model, or of one that may be replaced.

        Raises:
            NameTaken: there is one.
            RendezviewError: the name is invalid.
        """
        if not _NAME.fullmatch(name):
            raise RendezviewError(f"model name {name[:80]!r}: use letters, digits, - and _")
        taken = self._models.get(name)
        if taken is not None and not (replace and taken.own):
            raise NameTaken(
                f"model {name}: there is one already: choose another name, or ?replace=true"
            )
        return self.folder / f"{name}{SUFFIX}"

    def add(self, name: str, sent: Path, replace: bool = False) -> StoredModel:
        """Store an uploaded model after it is read and checked.

        Args:
            sent: its file; it is moved.
            replace: a model of this name may be there; sessions that use it keep it.

        Raises:
            NameTaken: there is one.
            RendezviewError: the name is invalid, or the content is not a model.
        """
        with self._lock:  # no other upload takes the name meanwhile
            path = self.path_for(name, replace)
            part = path.with_name(f".{secrets.token_hex(6)}.tmp")
            stored = self._stored(name, part, own=True)
            try:
                shutil.move(sent, part)
                _ = stored.model
                with open(part, "rb") as file:
                    os.fsync(file.fileno())
                stored.path = part.rename(path).resolve()
            except RendezviewError as error:
                said = str(error).replace(str(stored.path), "the model sent")
                raise RendezviewError(said) from None
            except OSError as error:
                raise write_error(path, error) from error
            finally:
                part.unlink(missing_ok=True)
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

    def rest(self, used: Iterable[StoredModel] = ()) -> None:
        """Give back the memory of models that nobody has asked for.

        Args:
            used: those of the sessions, which may have no name any more.
        """
        for stored in {*self._models.values(), *used}:
            stored.rest()

    def prune(self, used: set[str]) -> None:
        """Delete the copies of models that have no name any more and that nobody uses.

        Args:
            used: hashes of the models of the sessions.
        """
        if self._shared:
            return
        used = used | {other.sha256 for other in list(self._models.values()) if other.is_read}
        for copy in self._copies.glob(f"*{SUFFIX}"):
            if copy.stem not in used:
                copy.unlink(missing_ok=True)
