"""Storage of a sweep's trials: a database, Optuna's journal file or its gRPC proxy.

| `--storage`                              | storage                                | trials of machines that died |
| ---------------------------------------- | -------------------------------------- | ---------------------------- |
| none                                     | SQLite file in the folder of the sweep | same command                 |
| URL, such as `postgresql://user@host/db` | database                               | return after `GRACE_S`       |
| `grpc://HOST:PORT`                       | Optuna's proxy of a database           | same command                 |
| path                                     | Optuna's journal file                  | same command                 |
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import warnings
from collections.abc import Generator
from pathlib import Path
from urllib.parse import urlsplit

import grpc
import optuna
import sqlalchemy.exc
from optuna.storages import BaseStorage, GrpcStorageProxy, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from mjlab.sweep.settings import Sweep
from mjlab.utils.errors import MjlabError, UserError
from mjlab.utils.logging import first_line

HEARTBEAT_S = 60
"""Time between heartbeats of running trials (s)."""
GRACE_S = 600
"""Time without a heartbeat after which other machines train a trial (s)."""
STORAGE_ERRORS = (
    optuna.exceptions.OptunaError, sqlalchemy.exc.SQLAlchemyError, sqlite3.Error, grpc.RpcError,
)  # fmt: skip
_DATABASE = "study.db"
_GRPC = "grpc://"
# A setting that ends its machine, e.g. for lack of memory, would end one after the other.
_RETRIES = 3
_PATIENCE_S = 30.0
"""Time to wait for a proxy that starts together with the sweep (s)."""
# SQLite's errors of files that are not damaged.
_BLOCKED = (
    sqlite3.SQLITE_PERM, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN,
)  # fmt: skip


def open_storage(sweep: Sweep) -> BaseStorage:
    """Create or open the storage of a sweep."""
    address = sweep.storage
    if address is None:
        return RDBStorage(f"sqlite:///{(sweep.folder / _DATABASE).as_posix()}")
    with without_experimental_warnings():
        if address.startswith(_GRPC):
            parts = urlsplit(address)
            proxy = GrpcStorageProxy(host=parts.hostname or "localhost", port=parts.port or 13000)
            proxy.wait_server_ready(_PATIENCE_S)
            return proxy
        if "://" in address:
            return RDBStorage(
                address,
                heartbeat_interval=HEARTBEAT_S,
                grace_period=GRACE_S,
                heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(
                    _RETRIES
                ),
            )
    # Optuna releases the lock of a process that died only if the path is absolute.
    path = str(Path(address).absolute())
    # Links need privileges on Windows.
    lock = JournalFileOpenLock(path) if os.name == "nt" else None
    return JournalStorage(JournalFileBackend(path, lock))


def storage_summary(address: str) -> str:
    """Return what `--storage` is, and what becomes of settings of machines that died."""
    if "://" in address and not address.startswith(_GRPC):
        return (
            "database; settings of machines without a heartbeat for "
            f"{GRACE_S // 60} minutes are trained by others"
        )
    kind = f"proxy {address}" if address.startswith(_GRPC) else f"journal file {address}"
    return f"{kind}, without heartbeats; settings of machines that died wait for their command"


@contextlib.contextmanager
def without_experimental_warnings() -> Generator[None]:
    """Ignore Optuna's warnings of experimental features within the block."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield


@contextlib.contextmanager
def naming_storage(sweep: Sweep, *kinds: type[Exception]) -> Generator[None]:
    """Turn errors of these kinds within the block into a `UserError` with the storage and the cure."""
    try:
        yield
    except (MjlabError, MemoryError):
        raise
    except kinds as error:
        raise UserError(_cure(sweep, _first_cause(error))) from error


def _first_cause(error: BaseException) -> BaseException:
    cause = getattr(error, "orig", None) or error.__cause__
    # Of a proxy that does not answer, the cause has no message.
    return error if cause is None or isinstance(error, ConnectionError) else _first_cause(cause)


def _cure(sweep: Sweep, cause: BaseException) -> str:
    """Return the message of an error of the storage."""
    reason, path = first_line(cause), sweep.folder / _DATABASE
    if isinstance(cause, grpc.RpcError) and isinstance(cause, grpc.Call):
        reason = cause.details() or reason
    address = sweep.storage
    if address is None:
        is_blocked = getattr(cause, "sqlite_errorcode", 0) & 0xFF in _BLOCKED
        if is_blocked and (path.is_file() or not os.path.lexists(path)):
            return (
                f"{path}: cannot be read and written: {reason}; free it, or the disk, and "
                "repeat the command, which continues the sweep."
            )
        return (
            f"{path} is damaged ({reason}); delete it; the next call rebuilds it from the folders of the "
            "runs."
        )
    if address.startswith(_GRPC):
        return (
            f"--storage {address}: cannot use the proxy: {reason}; start it with Optuna's "
            "`run_grpc_proxy_server`, and repeat the command, which continues the sweep."
        )
    if "://" in address:
        # URLs may contain passwords.
        return (
            f"--storage: cannot use the database: {reason}; use a URL such as "
            "postgresql://user@host/database with its driver installed, the path of a journal file, or "
            "leave out --storage."
        )
    return (
        f"--storage {address}: cannot use the journal file: {reason}; use a path in a folder that can be "
        "written. If the file is damaged, delete it; each machine's next call adds its runs to a new one."
    )
