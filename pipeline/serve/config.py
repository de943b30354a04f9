"""What a server takes and refuses."""

from __future__ import annotations

from pydantic import Field

from motionloom.datasets.schema import Config


class ServeConfig(Config):
    """Where a server listens, and how much it takes on."""

    host: str = "127.0.0.1"
    """Address to listen at; anything but loopback lets others in."""
    port: int = Field(8000, ge=0, le=65535)
    """0 takes a free one."""
    allow_hosts: tuple[str, ...] = ()
    """Names that the server is reached by, besides localhost and addresses."""
    waiting: int = Field(32, ge=1)
    """Requests that wait for the model; more are refused."""
    max_seconds: float = Field(30.0, gt=0)
    """Longest motion."""
    max_caption: int = Field(300, ge=1)
    """Longest caption, in letters."""
    max_sound_mb: float = Field(20.0, gt=0)
    """Largest sound file."""
    max_sound_seconds: float = Field(300.0, gt=0)
    """Longest sound."""
    sounds: int = Field(4, ge=1)
    """Sounds that are kept; the one used longest ago makes room."""
    max_request_kb: float = Field(16.0, gt=0)
    """Largest request besides a sound."""
    patience: float = Field(20.0, gt=0)
    """Seconds in which a request must have arrived."""
