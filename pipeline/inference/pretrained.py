"""`MotionModel`: a trained model in one folder, saved, loaded and shared through the hub.

    model = MotionModel.from_pretrained("exported")        # a folder, or a name on the Hugging Face hub
    motions = model.generate(["a person waves"], seed=1)
    motions[0].joints                                      # [T, N, 3] metres

The folder holds weights (safetensors), configs, statistics, the skeleton and, where it does not come with the
installation, the text encoder: nothing else is needed, and nothing in it is ever unpickled or run.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import ModelHubMixin, snapshot_download
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.bundle import (
    PARTS,
    Bundle,
    BundleFile,
    GeneratedMotion,
    part_folders,
    text_encoder_of,
)
from motionloom.pipeline.inference.sampling import SamplingConfig
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.store.encoder_files import BUILT_IN, copy_encoder
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.weights import LayoutFacts

_WEIGHTS = ("model.safetensors", "model.json", "stats.safetensors")
_ENCODER = "text_encoder"
_HUB_CONFIG = {"format": "motionloom bundle"}
"""`config.json`, which the hub looks for; nothing here reads it."""


class MotionModel(
    ModelHubMixin,
    library_name="motionloom",
    pipeline_tag="text-to-3d",
    tags=["human-motion", "text-to-motion", "whole-body"],
):
    """Captions to whole-body motions."""

    def __init__(self, folder: Path | str, device: str | torch.device = "auto") -> None:
        self.folder = Path(folder)
        self.bundle = Bundle.open(self.folder, choose_device(device))
        # The mixin would write our argument, a local path, into the config.json that the hub wants.
        self._hub_mixin_config = dict(_HUB_CONFIG)

    @classmethod
    def from_pretrained(cls, pretrained_model_name_or_path: str | Path, **options: Any) -> MotionModel:
        """A folder, or a name on the hub.

        `options` are `device` (auto: a GPU if there is one; cpu, cuda, cuda:N) and the hub's (revision,
        token, local_files_only).
        """
        name = pretrained_model_name_or_path
        if Path(name).is_dir():  # the hub's own way in warns of a run folder, which has no config.json
            return cls(name, options.get("device", "auto"))
        try:
            return super().from_pretrained(name, **options)
        except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError) as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise UserError(f"{name}: no such folder, and the hub does not give it ({reason})") from None

    def generate(
        self,
        captions: Sequence[str],
        *,
        face_captions: Sequence[str] | None = None,
        seconds: float | Sequence[float] | None = None,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, Any] | None = None,
    ) -> list[GeneratedMotion]:
        """Motions for captions, in order; the same seed, captions and settings give the same motions.

        A motion's draws go by its place in the list. `seconds` is one length for all or one each; without it
        the model decides. `sampling` is a `SamplingConfig` or a mapping like `{"top_p": 0.9}`. An option that
        this model takes no notice of is refused.
        """
        return self.bundle.generate(
            captions, face_captions=face_captions, seconds=seconds, seed=seed, sampling=sampling, strict=True
        )

    def _save_pretrained(self, save_directory: Path) -> None:
        """Copy all that `generate` needs into the folder."""
        if (self.folder / "bundle.json").is_file():
            shutil.copytree(self.folder, save_directory, dirs_exist_ok=True)
        else:
            write_bundle(self.folder, save_directory)

    @classmethod
    def _from_pretrained(
        cls,
        *,
        model_id: str,
        revision: str | None = None,
        cache_dir: str | Path | None = None,
        force_download: bool = False,
        local_files_only: bool = False,
        token: str | bool | None = None,
        device: str | torch.device = "auto",
        **kwargs: Any,
    ) -> MotionModel:
        """Open a folder, or fetch one from the hub first."""
        if Path(model_id).is_dir():
            return cls(model_id, device)
        folder = snapshot_download(
            model_id, revision=revision, cache_dir=cache_dir, force_download=force_download,
            local_files_only=local_files_only, token=token,
            allow_patterns=["*.json", "*.safetensors", f"{_ENCODER}/*"],
        )  # fmt: skip
        return cls(folder, device)


def write_bundle(run: Path, out: Path) -> None:
    """Copy what generation needs of a run's finished stages into `out`; `bundle.json` is written last."""
    parts = part_folders(run)
    bundle = Bundle.from_run(run)  # opens every part, so a broken one is found before anything is copied
    encoder = text_encoder_of(parts["text"])
    if encoder != BUILT_IN:  # first, because it may not be found any more
        copy_encoder(encoder, parts["text"], out / _ENCODER)
        encoder = _ENCODER
    for role, source in parts.items():
        if role == "text":
            continue
        (out / role).mkdir(parents=True, exist_ok=True)
        for name in _WEIGHTS:
            if (source / name).is_file():
                shutil.copyfile(source / name, out / role / name)
    skeleton = bundle.layout.skeleton
    write_json(out / "skeleton.json", _plain(skeleton))
    write_json(out / "config.json", _HUB_CONFIG)
    held = tuple(part for part in PARTS if part in parts and part != "text")
    facts = BundleFile(layout=LayoutFacts.of(bundle.layout), text_encoder=encoder, parts=held)
    write_json(out / "bundle.json", facts.dump())


def _plain(skeleton: Skeleton) -> dict[str, Any]:
    made = {
        "name": skeleton.name,
        "joints": skeleton.joints,
        "parents": skeleton.parents,
        "offsets": skeleton.rest,
    }
    return dict(json.loads(json.dumps(made)))
