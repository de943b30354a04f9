"""`Sounds`: music that was sent to the server, by a name made of its content."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np

from motionloom.datasets.audio.sound import Sound, read_sound, require_audible, sound_seconds
from motionloom.datasets.schema import UserError
from motionloom.pipeline.serve.config import ServeConfig

_NAME = "the sound"
_KINDS = {b"RIFF": ".wav", b"RF64": ".wav", b"fLaC": ".flac", b"OggS": ".ogg"}
"""First bytes and the file's ending; what begins otherwise is tried as MP3."""


class Sounds:
    """The sounds used last."""

    def __init__(self, config: ServeConfig) -> None:
        self._config = config
        self._kept: OrderedDict[str, Sound] = OrderedDict()
        self._lock, self._decoding = threading.Lock(), threading.Lock()

    def add(self, data: bytes) -> tuple[str, Sound]:
        """Decode a file's bytes and keep them; `UserError` for what is no sound, silent or too long."""
        if not data:
            raise UserError(f"{_NAME}: empty (0 bytes)")
        name = hashlib.sha256(data).hexdigest()[:24]
        with self._decoding:  # one at a time: a sound takes several times its file's memory
            with self._lock:
                sound = self._kept.pop(name, None)
            sound = self._decode(data) if sound is None else sound
            with self._lock:
                self._kept[name] = sound
                while len(self._kept) > self._config.sounds:
                    self._kept.popitem(last=False)
        return name, sound

    def get(self, name: str) -> Sound:
        """A sound by its name."""
        with self._lock:
            sound = self._kept.get(name)
            if sound is None:
                raise UserError("the sound is not here any more; send it again")
            self._kept.move_to_end(name)
            return sound

    def _decode(self, data: bytes) -> Sound:
        longest = self._config.max_sound_seconds
        with tempfile.TemporaryDirectory(prefix="motionloom-") as folder:
            path = Path(folder) / f"sound{_KINDS.get(data[:4], '.mp3')}"
            path.write_bytes(data)
            seconds = sound_seconds(path, _NAME)
            if seconds > longest:
                raise UserError(f"{_NAME} lasts {seconds:.0f} s; this server takes at most {longest:g} s")
            samples, rate = read_sound(path, _NAME)
        require_audible(samples, _NAME)
        return Sound(np.clip(samples, -1.0, 1.0), rate)
