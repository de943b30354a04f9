"""How a data set is read: by which reader, in which order, and with which local cache."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from motionloom.datasets.schema import Config


class CacheConfig(Config):
    """Where shards from a server are kept on this machine. Folders are read in place, without a cache."""

    folder: str | None = None
    """A folder that processes and runs may share; unset means `motionloom/shards` in the user's cache."""
    gigabytes: float = Field(50.0, ge=0)
    """Size limit (10^9 bytes); the shards unused for longest go first. 0 keeps no shard: every clip is a
    range request of its own."""

    @property
    def limit(self) -> int:
        """The limit in bytes."""
        return int(self.gigabytes * 1e9)


class Reading(Config):
    """Reader and order of one data set."""

    mode: Literal["indexed", "streamed"] = "indexed"
    """`indexed` reads clips where they lie; `streamed` reads whole shards front to back (WebDataset)."""
    order: Literal["global", "streamed"] = "global"
    """`global` shuffles all clips each epoch; `streamed` shuffles shards, and the clips of
    `shards_per_group` shards at a time. Both readers give the same batches in the streamed order."""
    shards_per_group: int = Field(8, ge=1)
    """Shards whose clips are mixed in the streamed order; the streaming reader holds two groups in memory."""
    cache: CacheConfig = CacheConfig()

    @model_validator(mode="after")
    def _streams_need_their_order(self) -> Self:
        if self.mode == "streamed" and self.order != "streamed":
            raise ValueError("mode: streamed reads shard after shard and needs order: streamed")
        return self
