"""A training whose disk runs full says so, keeps what it has, and goes on once there is room."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_disk import small_disk, why_not
from tiny_players import train

from motionloom.datasets.base.os_errors import sentence_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.stages.training import read_metrics
from motionloom.pipeline.store.checkpoints import readable

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())
STEPS, EVERY = 24, 6


def sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in sorted(folder.glob("*"))}


@pytest.mark.parametrize("room", [0.0, 0.5, 1.5])
def test_it_goes_on_bit_for_bit_once_there_is_room(room: float, tmp_path: Path) -> None:
    """`room`: what the disk still takes when the second checkpoint is to be written, in checkpoints."""
    settings = {"steps": STEPS, "checkpoint_every": EVERY}
    whole = train(tmp_path / "whole", **settings)
    checkpoint = max(sizes(tmp_path / "whole/checkpoints").values())
    with small_disk(tmp_path / "disk", 64 * checkpoint) as disk:
        folder = disk.folder / "stage"
        with pytest.raises(ConnectionResetError):
            train(folder, dies_at=EVERY + 2, **settings)
        before = sizes(folder / "checkpoints")
        assert list(before) == [f"step={EVERY:08d}.ckpt"]
        disk.fill(leave=int(room * checkpoint))
        with pytest.raises((UserError, OSError)) as failure:
            train(folder, **settings)
        error = failure.value
        said = str(error) if isinstance(error, UserError) else sentence_of(error)
        assert "No space left on device" in said or "the disk is full" in said
        assert str(disk.folder) in said and "same command" in said
        after = sizes(folder / "checkpoints")
        assert before.items() <= after.items() and len(after) == (2 if room > 1 else 1)
        said_of: list[str] = []
        sound = {path.name for path, _ in readable(folder / "checkpoints", said_of.append)}
        assert sound == set(after) and not said_of, "nothing half-written stays"
        disk.make_room()
        again = train(folder, **settings)
        for name, value in whole.state_dict().items():
            assert torch.equal(value, again.state_dict()[name]), name
        assert read_metrics(folder) == read_metrics(tmp_path / "whole")
