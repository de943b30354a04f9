"""Stores of a data set's files: a folder, a web server, an S3 bucket or a data set on the hub, alike.

Only the schemes of `SCHEMES` are opened, and the check comes before anything else: no `pipe:`, no chained or
shell URL ever reaches a library. Requests go through fsspec and are repeated by `persist`. Credentials
come from the environment alone; a URL that carries some is refused.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import os
import random
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast
from urllib.parse import unquote, urlsplit

from motionloom.datasets.base.connection import connect
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file, atomic_path, sha256_of, temporary_folder, write_json
from motionloom.datasets.base.json_doors import open_plain, read_plain
from motionloom.datasets.base.places import no_such_folder
from motionloom.datasets.base.records import INDEX_FILE, MANIFEST_FILE, ShardInfo
from motionloom.datasets.shards.cache import CacheConfig, FileCache
from motionloom.datasets.shards.checksums import LocalShard, fault_of

SCHEMES = ("file", "http", "https", "s3", "gs", "az", "hf")

_SETTINGS = ("AWS_", "AZURE_", "GOOGLE_", "HF_", "STORAGE_")
"""What variables of the environment begin with that a connection goes by."""
_LARGEST_PUT = 5 << 30
"""Bytes of an object that S3 takes in one piece, and so has one sha256 of."""


def is_url(place: Path | str) -> bool:
    """Whether a place is on a server."""
    return isinstance(place, str) and _scheme(place) not in (None, "file")


def open_store(place: Path | str, cache: CacheConfig | None = None) -> Store:
    """The store at a folder or URL; `UserError` for a scheme that is not allowed. Reads nothing yet."""
    scheme = _scheme(place) if isinstance(place, str) else None
    if scheme is None:
        return LocalStore(Path(place))
    if scheme not in SCHEMES:
        raise UserError(
            f"{place}: data is read from {', '.join(f'{s}:' for s in SCHEMES)} and folders, not from "
            f"'{scheme}:' (a folder with such a name: write ./{place})"
        )
    url = urlsplit(str(place))
    if scheme == "file":
        if url.netloc not in ("", "localhost") or not url.path.startswith("/"):
            raise UserError(f"{place}: write a file URL as file:///folder")
        return LocalStore(Path(unquote(url.path)))
    if url.username is not None or url.password is not None:
        raise UserError(
            f"{url.scheme}://…@{url.hostname}: credentials belong in the environment, not in the URL"
        )
    if not url.hostname or url.query or url.fragment or ".." in url.path.split("/"):
        raise UserError(f"{place}: write it as {scheme}://host-or-bucket/folder, without '?', '#' and '..'")
    return RemoteStore(str(place).rstrip("/"), cache or CacheConfig())


def _scheme(place: str) -> str | None:
    match = re.match(r"([A-Za-z][A-Za-z0-9+.-]*):", place)
    return match.group(1).lower() if match else None


class LocalStore:
    """A folder of this machine."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.place = str(root)

    def where(self, name: str) -> str:
        """Path or URL of a file, for messages."""
        return str(self.root / name)

    def read_manifest(self, digest: str | None = None) -> bytes:
        """Content of `manifest.json`; with `digest` (sha256, hex) that content or a `UserError`."""
        where = self.where(MANIFEST_FILE)
        try:
            return _as_before(read_plain(self.root / MANIFEST_FILE), digest, where)
        except FileNotFoundError:
            if not self.root.is_dir():
                raise UserError(no_such_folder(self.root)) from None
            raise MissingFileError(f"{where}: no such file") from None
        except OSError as error:
            raise UserError(f"{where}: cannot be read ({error.strerror or error})") from None

    def open_index(self, digest: str, name: str = INDEX_FILE) -> BinaryIO:
        """`index.npz` of the manifest with that sha256, or another that `digest` decides, seekable."""
        try:
            return open_plain(self.root / name, self.where(name))
        except FileNotFoundError:
            raise MissingFileError(f"{self.where(name)}: no such file") from None
        except OSError as error:
            raise UserError(f"{self.where(name)}: cannot be read ({error.strerror or error})") from None

    def open_shard(self, shard: ShardInfo) -> int:
        """A descriptor of a shard, to be closed by the caller. A pipe is not waited for."""
        try:
            return os.open(self.root / shard.name, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except FileNotFoundError:
            raise MissingFileError(f"{self.where(shard.name)}: no such file") from None
        except OSError as error:
            raise UserError(f"{self.where(shard.name)}: cannot be read ({error.strerror or error})") from None

    def digest(self, name: str) -> str | None:
        """sha256 of a stored file; None if it is missing."""
        try:
            return sha256_of(self.root / name)
        except FileNotFoundError:
            return None

    def put(self, path: Path, name: str, sha256: str) -> None:
        """Store a file of this machine, whose sha256 is given, under a name."""
        with path.open("rb") as file, atomic_file(self.root / name) as into:
            shutil.copyfileobj(file, into)

    def get(self, name: str, path: Path) -> None:
        """Fetch a stored file to a path of this machine, where it appears whole."""
        with self.open_index("", name) as file, atomic_file(path) as into:
            shutil.copyfileobj(file, into)

    def names(self, folder: str) -> list[str]:
        """Names of all files stored below a folder, sorted."""
        below = sorted(path for path in (self.root / folder).rglob("*") if path.is_file())
        return [path.relative_to(self.root).as_posix() for path in below]

    def remove(self, name: str) -> None:
        """Delete a stored file."""
        (self.root / name).unlink()


class RemoteStore:
    """A URL, whose files are cached whole. Stores of one process share connections."""

    def __init__(self, url: str, cache: CacheConfig) -> None:
        self.place = url
        self.cache = FileCache(cache)

    def where(self, name: str) -> str:
        return f"{self.place}/{name}"

    def read_manifest(self, digest: str | None = None) -> bytes:
        if digest is not None:
            cached = self.cache.find(f"{digest}.manifest.json")
            if cached is not None:
                with cached:
                    return cached.read()
        where = self.where(MANIFEST_FILE)
        raw = _as_before(persist(where, lambda: self.system().cat_file(where), first=True), digest, where)
        name = f"{hashlib.sha256(raw).hexdigest()}.manifest.json"
        self.cache.get(name, len(raw), lambda path: path.write_bytes(raw)).close()
        return raw

    def open_index(self, digest: str, name: str = INDEX_FILE) -> BinaryIO:
        """Open `index.npz`, cached under the manifest's checksum, which decides its content."""
        url = self.where(name)

        def fetch(path: Path) -> None:
            persist(url, lambda: self.system().get_file(url, str(path)))

        return self.cache.get(f"{digest}.index.npz", 0, fetch)

    def open_shard(self, shard: ShardInfo) -> int:
        """The same in the cache, where it was compared with the manifest's sha256 when it arrived."""
        with self.cache.get(
            f"{shard.sha256}.tar", shard.bytes, lambda path: self._fetch(shard, path)
        ) as file:
            return os.dup(file.fileno())

    def digest(self, name: str) -> str | None:
        """The same, from the record of the bucket or the hub; from the file's bytes where it has none."""
        where = self.where(name)

        def found() -> str:
            system = self.system()
            if _scheme(where) == "s3":
                head = system.call_s3("head_object", **_object(system, where), ChecksumMode="ENABLED")
                known = head.get("ChecksumSHA256", "-")
                if "-" not in known:  # of several parts it is the sum of their sums
                    return base64.b64decode(known).hex()
            elif large := system.info(where).get("lfs"):
                return str(large["sha256"])
            with system.open(where, "rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()

        try:
            return persist(where, found, first=True)
        except MissingFileError:
            return None

    def put(self, path: Path, name: str, sha256: str) -> None:
        """The same. A bucket compares what arrives with the sha256, and keeps it for `digest`."""
        where = self.where(name)

        def send() -> None:
            system = self.system()
            if _scheme(where) != "s3" or path.stat().st_size > _LARGEST_PUT:
                system.put_file(str(path), where)
                return
            known = base64.b64encode(bytes.fromhex(sha256)).decode()
            expected = {"ChecksumAlgorithm": "SHA256", "ChecksumSHA256": known}
            with path.open("rb") as file:
                system.call_s3("put_object", **_object(system, where), **expected, Body=file)

        try:
            persist(where, send)
        except MissingFileError:
            raise UserError(f"{self.place}: no such bucket or repository; make it first") from None

    def get(self, name: str, path: Path) -> None:
        where = self.where(name)
        with atomic_path(path) as whole:
            persist(where, lambda: self.system().get_file(where, str(whole)))

    def names(self, folder: str) -> list[str]:
        where = self.where(folder).rstrip("/")
        try:
            found = persist(where, lambda: self.system().find(where), first=True)
        except MissingFileError:
            return []
        start = len(self.system()._strip_protocol(self.place).rstrip("/")) + 1
        # A bucket may have any key: none leads out of the folder that it is fetched into.
        return sorted(name[start:] for name in found if ".." not in name.split("/"))

    def remove(self, name: str) -> None:
        where = self.where(name)
        persist(where, lambda: self.system().rm_file(where))

    def _fetch(self, shard: ShardInfo, path: Path) -> None:
        url = self.where(shard.name)

        def fetch() -> None:
            self.system().get_file(url, str(path))
            if fault := fault_of(LocalShard(path, shard)):
                raise OSError(fault)

        persist(url, fetch)

    def system(self) -> Any:
        """The fsspec file system that `where` names files of."""
        settings = tuple(sorted(item for item in os.environ.items() if item[0].startswith(_SETTINGS)))
        return connect(cast(str, _scheme(self.place)), os.getpid(), settings)


def _object(system: Any, where: str) -> dict[str, str]:
    """Bucket and key of an S3 URL."""
    bucket, key, _ = system.split_path(where)
    return {"Bucket": bucket, "Key": key}


Store = LocalStore | RemoteStore
"""The files of one data set, by name."""


def read_stored(store: Store, name: str) -> bytes:
    """Content of a small stored file; `MissingFileError` if there is none."""
    with temporary_folder() as folder:
        store.get(name, folder / "file")
        return read_plain(folder / "file", name=store.where(name))


def write_stored(store: Store, name: str, record: object) -> None:
    """Store a record as JSON."""
    with temporary_folder() as folder:
        write_json(folder / "file", record)
        store.put(folder / "file", name, sha256_of(folder / "file"))


def _as_before(raw: bytes, digest: str | None, where: str) -> bytes:
    if digest is not None and hashlib.sha256(raw).hexdigest() != digest:
        raise UserError(f"{where}: changed while the data set was in use; start again")
    return raw


ATTEMPTS = 8
FIRST_PAUSE, LONGEST_PAUSE = 0.2, 15.0
"""Seconds between tries: doubled each time, at random between half and whole."""

_LIBRARIES = {
    "adlfs", "aiohttp", "aiobotocore", "azure", "botocore", "fsspec", "gcsfs", "google", "httpx", "httpx2",
    "huggingface_hub", "s3fs", "urllib3",
}  # fmt: skip
_ABSENT = "no such file on the server"

T = TypeVar("T")


class MissingFileError(UserError):
    """A data set has no file of that name."""


def persist(what: str, action: Callable[[], T], *, first: bool = False) -> T:
    """Run `action`, again after failures that may pass; `UserError` naming `what` when it stays refused.

    A connection that is refused is an answer where a server is asked for the `first` time, most likely to a
    mistyped address; one that has answered before may be starting again.
    """
    failure: BaseException = OSError("never tried")
    for attempt in range(ATTEMPTS):
        if attempt:
            pause = min(FIRST_PAUSE * 2 ** (attempt - 1), LONGEST_PAUSE)
            # Not the global generator: a retry must not shift the run's own random draws.
            time.sleep(pause * random.SystemRandom().uniform(0.5, 1.0))
        try:
            return action()
        except Exception as error:
            # Only the network's and the disk's errors may pass, no mistake in a program.
            library = type(error).__module__.partition(".")[0]
            if isinstance(error, UserError) or not (isinstance(error, OSError) or library in _LIBRARIES):
                raise
            if _lacks_place(error):
                raise UserError(f"{what}: no such bucket or repository; check its name, or make it") from None
            refusal = _refusal(error)
            if isinstance(error, FileNotFoundError) or refusal == _ABSENT:
                raise MissingFileError(f"{what}: {_ABSENT}") from None
            if first and refusal is None and _nobody_listens(error):
                refusal = "the connection is refused: no server listens there; check host and port"
            if refusal is not None:
                raise UserError(f"{what}: {refusal}") from None
            failure = error
    reason = " ".join(str(failure).split()) or type(failure).__name__
    raise UserError(f"{what}: {reason[:300]} (tried {ATTEMPTS} times)") from None


def _refusal(error: Exception) -> str | None:
    """Return why an error is final, or None if repeating may help."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "the disk of the cache folder is full; free space or lower the cache's gigabytes"
    if isinstance(error, TimeoutError):
        return None
    status = _status(error)
    if isinstance(error, PermissionError) or status in (401, 403):
        return (
            "the server refuses access; set the credentials in the environment (AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY, or AWS_PROFILE; HF_TOKEN) and check that they may read here"
        )
    if "Credentials" in type(error).__name__ or type(error).__name__ in (
        "ProfileNotFound",
        "TokenRetrievalError",
    ):
        return f"no usable credentials in the environment ({error})"
    if status in (404, 410):
        return _ABSENT
    if status is not None and 400 <= status < 500 and status not in (408, 425, 429):
        return f"the server refuses the request (HTTP {status}: {' '.join(str(error).split())[:200]})"
    return None


def _lacks_place(error: Exception) -> bool:
    """Whether not a file is missing but what files are in, as s3fs and the hub's library say it."""
    answer = getattr(error.__cause__, "response", {})
    code = answer.get("Error", {}).get("Code") if isinstance(answer, dict) else None
    return code == "NoSuchBucket" or "repository not found" in str(error)


def _nobody_listens(error: BaseException | None) -> bool:
    while error is not None:
        if getattr(error, "errno", None) == errno.ECONNREFUSED:
            return True
        error = error.__cause__ or error.__context__
    return False


def _status(error: BaseException | None) -> int | None:
    """HTTP status behind an error or one of its causes."""
    while error is not None:
        own = "code" if type(error).__module__.startswith("gcsfs") else "status_code"
        status = getattr(error, "status", None) or getattr(error, own, None)
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode", status)
        elif response is not None:  # of the hub's library
            status = getattr(response, "status_code", status)
        if isinstance(status, int):
            return status
        error = error.__cause__ or error.__context__
    return None
