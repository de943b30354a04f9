"""Everything that turns a caption into motion: text encoder, TMA, GPT, tokenizer, statistics, face line.

A bundle opens from a run folder or from an exported one; both hold one folder per part.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.features import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.text.encoder import EncodedText, TextEncoder, load_text_encoder
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.sampling import generate, sample_seeds
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.inference.faces import (
    FaceGenerator,
    FaceKind,
    FaceRequest,
    choose,
    expression,
    load_faces,
)
from motionloom.pipeline.inference.requests import (
    caption_list,
    require_seed,
    require_used,
    require_words,
    sampling_of,
)
from motionloom.pipeline.inference.sampling import SamplingConfig
from motionloom.pipeline.store.artifact import Artifact, require_consistent
from motionloom.pipeline.store.encoder_files import BUILT_IN, place_of
from motionloom.pipeline.store.networks import CPU, LoadedTma, device_of, load_gpt, load_tokenizer
from motionloom.pipeline.store.weights import LayoutFacts
from motionloom.pipeline.store.yaml import read_yaml

PARTS = (
    "stats", "text", "tokenizer", "tma", "gpt", "face_tokenizer", "face_gpt", "face_vae", "face_diffusion",
)  # fmt: skip
REQUIRED = ("stats", "tokenizer", "gpt")


class BundleFile(Config):
    """`bundle.json` of an exported folder."""

    layout: LayoutFacts
    text_encoder: str
    """`minilm`, or the folder beside this file."""
    parts: tuple[str, ...] | None = None
    """The folders of the parts; a folder of an earlier version does not list them."""

    def encoder_in(self, folder: Path) -> str:
        """The text encoder to load: nothing outside `folder` is ever followed."""
        name = self.text_encoder
        if name == BUILT_IN:
            return name
        if name in {"", ".", ".."} or "/" in name or "\\" in name or not (folder / name).is_dir():
            raise UserError(
                f"{folder / 'bundle.json'}: text_encoder = {name!r} is neither '{BUILT_IN}' nor a folder "
                f"beside this file; export the run again"
            )
        return str(folder / name)

    def parts_in(self, folder: Path) -> dict[str, Path]:
        """The folder of each part."""
        if self.parts is None:
            return {part: folder / part for part in PARTS if (folder / part).is_dir()}
        for part in self.parts:
            if part not in PARTS or not (folder / part).is_dir():
                raise UserError(
                    f"{folder / 'bundle.json'}: its part '{part}' is not here; copy the whole folder, or "
                    f"export the run again"
                )
        return {part: folder / part for part in self.parts}


@dataclass(frozen=True)
class GeneratedMotion:
    """One generated clip."""

    caption: str
    face_caption: str
    features: NDArray[np.float32]
    """Body-hand features [T, D]."""
    joints: NDArray[np.float64]
    """Positions [T, N, 3] in metres."""
    face: NDArray[np.float32] | None
    """Expression [T, 50], or None without a face line."""
    layout: MotionLayout


@dataclass(frozen=True)
class Bundle:
    """The parts, loaded once and all on one device."""

    layout: MotionLayout
    stats: FeatureStats
    text_encoder_name: str
    tokenizer: Tokenizer
    gpt: InterleavedGPT
    prior: str
    tma: LoadedTma | None
    faces: dict[FaceKind, FaceGenerator]
    """The face generators here, the paper's first; empty for body-only models."""

    @staticmethod
    def open(folder: Path, device: torch.device = CPU) -> Bundle:
        """Open a run folder or an exported folder."""
        if (folder / "bundle.json").is_file():
            facts = BundleFile.load_json(folder / "bundle.json")
            return Bundle.from_parts(facts.parts_in(folder), facts.encoder_in(folder), device)
        if not (folder / "recipe.yaml").is_file():
            raise UserError(
                f"{folder}: not a run folder (no recipe.yaml) and not an exported one (no bundle.json)"
            )
        return Bundle.from_run(folder, device)

    @staticmethod
    def from_run(run: Path, device: torch.device = CPU) -> Bundle:
        """Open the finished stages of a run."""
        parts = part_folders(run)
        require_consistent(run, (folder.name for folder in parts.values()))
        if "text" not in parts:
            raise UserError(f"{run}: no finished text stage; run the recipe to the end first")
        return Bundle.from_parts(parts, text_encoder_of(parts["text"]), device)

    @staticmethod
    def from_parts(parts: dict[str, Path], text_encoder: str, device: torch.device = CPU) -> Bundle:
        """Open one folder per part."""
        for role in REQUIRED:
            if role not in parts:
                raise UserError(f"no finished '{role}' stage here; run the recipe to the end first")
        tokenizer = load_tokenizer(parts["tokenizer"], device)
        gpt, prior = load_gpt(parts["gpt"], tokenizer)
        return Bundle(
            layout=tokenizer.layout,
            stats=FeatureStats.load(parts["stats"] / "stats.safetensors"),
            text_encoder_name=text_encoder,
            tokenizer=tokenizer,
            gpt=gpt,
            prior=prior,
            tma=LoadedTma.load(parts["tma"], device) if "tma" in parts else None,
            faces=load_faces(parts, device),
        )

    @cached_property
    def text_encoder(self) -> TextEncoder:
        """Loaded on first use; it is the slow part of starting."""
        return load_text_encoder(self.text_encoder_name, device=str(self.device))

    @property
    def device(self) -> torch.device:
        """Where all networks lie; what is made comes back as numpy arrays."""
        return device_of(self.gpt)

    @property
    def max_seconds(self) -> float:
        """Longest motion the GPT's block holds."""
        return self.max_groups * self.tokenizer.group_frames / self.layout.fps

    @property
    def max_groups(self) -> int:
        """Longest motion in groups of frames."""
        return self.gpt.max_groups

    def generate(
        self,
        captions: Sequence[str],
        *,
        face_captions: Sequence[str] | None = None,
        seconds: float | Sequence[float] | None = None,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, Any] | None = None,
        batch: int = 64,
        strict: bool = False,
    ) -> list[GeneratedMotion]:
        """Motions for captions, in order; the same seed, captions and settings give the same motions.

        A motion's draws go by its place in the list. `seconds` is one length for all or one each; without it
        the model decides. With `strict`, empty captions and options without effect are refused.
        """
        captions, sampling = caption_list(captions), sampling_of(sampling)
        require_seed(seed)
        faces = captions if face_captions is None else caption_list(face_captions, "face_captions")
        if strict:
            require_words(captions)
            require_words(faces, "face_captions")
            require_used(self.faces, face_captions, sampling)
        if len(faces) != len(captions):
            raise UserError(f"{len(captions)} captions but {len(faces)} face captions")
        groups = self._groups(seconds, len(captions))
        # One seed a motion, so that how they are batched plays no part.
        seeds = sample_seeds(seed, 2 * len(captions))
        out: list[GeneratedMotion] = []
        for start in range(0, len(captions), batch):
            part = slice(start, start + batch)
            both = seeds[: len(captions)][part], seeds[len(captions) :][part]
            lengths = None if groups is None else groups[part]
            out += self._batch(captions[part], faces[part], lengths, both, sampling)
        return out

    def _batch(
        self,
        captions: list[str],
        faces: list[str],
        groups: Tensor | None,
        seeds: tuple[list[int], list[int]],
        sampling: SamplingConfig,
    ) -> list[GeneratedMotion]:
        codes, lengths = self._sample(captions, groups, seeds[0], sampling)
        body = self._decode(codes, lengths)
        expressions: list[NDArray[np.float32]] | list[None] = [None] * len(captions)
        face = choose(self.faces, sampling.face_model)
        if face is not None:
            encoded = self.text_encoder.encode(faces)
            prior = self._tma_text(encoded) if self.tma is not None else None
            # The face takes the body's length, so that both share one time line.
            frames = [len(motion) for motion in body]
            made = face.make(FaceRequest(encoded, prior, frames, seeds[1], sampling))
            expressions = [expression(values, self.layout, self.stats) for values in made]
        out = []
        for row, caption in enumerate(captions):
            joints = decode(body[row], self._joint_layout)
            out.append(GeneratedMotion(caption, faces[row], body[row], joints, expressions[row], self.layout))
        return out

    @cached_property
    def _joint_layout(self) -> MotionLayout:
        """The layout of the body-hand columns alone."""
        if not self.layout.has("face"):
            return self.layout
        return MotionLayout.named("wholebody313", fps=self.layout.fps, family=self.layout.family)

    def _groups(self, seconds: float | Sequence[float] | None, count: int) -> Tensor | None:
        """Lengths in groups of frames, int64 [count]."""
        if seconds is None:
            return None
        wanted = list(seconds) if isinstance(seconds, Iterable) else [seconds] * count
        if len(wanted) != count:
            raise UserError(f"{count} captions but {len(wanted)} lengths in seconds")
        unit, fps = self.tokenizer.group_frames, self.layout.fps
        out = []
        for length in wanted:
            groups = round(length * fps / unit) if math.isfinite(length) else 0
            if not 1 <= groups <= self.max_groups:
                raise UserError(
                    f"{length:g} s is out of reach: this model makes {unit / fps:.2g} to "
                    f"{self.max_seconds:.1f} s"
                )
            out.append(groups)
        return torch.tensor(out)

    def _sample(
        self, texts: list[str], groups: Tensor | None, seeds: list[int], s: SamplingConfig
    ) -> tuple[dict[str, Tensor], Tensor]:
        result = generate(
            self.gpt,
            self.embed(texts),
            groups=groups,
            temperature=s.temperature,
            top_k=s.top_k or None,
            top_p=s.top_p,
            cfg_scale=s.cfg_scale,
            seed=seeds,
        )
        return result.codes, result.groups

    def embed(self, texts: list[str]) -> Tensor:
        """The GPT's text priors [n, E], on its device."""
        encoded = self.text_encoder.encode(texts)
        if self.prior == "sentence":
            return torch.as_tensor(encoded.sentence).to(self.device)
        return self._tma_text(encoded)

    def _tma_text(self, encoded: EncodedText) -> Tensor:
        if self.tma is None:
            raise UserError("this GPT needs the TMA text encoder, and no tma part is here")
        return self.tma.embed_text(torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask))

    def _decode(self, codes: dict[str, Tensor], groups: Tensor) -> list[NDArray[np.float32]]:
        """Features in their own units, [T, D] a sample; each is decoded alone, so padding plays no part."""
        streams, columns = self.tokenizer.streams, self.tokenizer.columns.cpu().numpy()
        out = []
        for row, count in enumerate(groups.tolist()):
            single = {s.name: codes[s.name][row : row + 1, : count * s.per_group] for s in streams}
            with torch.no_grad():
                motion = self.tokenizer.decode(single)[0].cpu().numpy()
            out.append((motion * self.stats.std[columns] + self.stats.mean[columns]).astype(np.float32))
        return out


def part_folders(run: Path) -> dict[str, Path]:
    """Folder of each part in a run: as its `generate` stage names them, else by the part's own name."""
    stages = stages_of(run)
    roles = {part: part for part in PARTS if part in stages}
    for entry in stages.values():
        if entry["kind"] == "generate":
            roles.update({r: s for r, s in entry.get("inputs", {}).items() if r in PARTS})
    found = {role: run / "stages" / stage for role, stage in roles.items() if stage}
    return {role: folder for role, folder in found.items() if (folder / "artifact.json").is_file()}


def text_encoder_of(text_folder: Path) -> str:
    """The text encoder a text stage used: `minilm`, an absolute folder or a hub name."""
    artifact = Artifact.find(text_folder)
    if artifact is None:
        raise UserError(f"{text_folder}: the text stage has not finished")
    return place_of(text_folder) or str(artifact.config["encoder"])


def stages_of(run: Path) -> dict[str, dict]:
    """The stages of a run's resolved recipe, as they are written there."""
    require_run(run)
    path = run / "recipe.yaml"
    recipe = read_yaml(path)
    stages = recipe.get("stages") if isinstance(recipe, dict) else None
    if not isinstance(stages, dict) or not all(isinstance(e, dict) and "kind" in e for e in stages.values()):
        raise UserError(f"{path}: holds no stages; run the recipe again into this folder")
    return stages


def require_run(folder: Path) -> None:
    """Refuse what is no run folder, and say what it is instead."""
    if (folder / "recipe.yaml").is_file():
        return
    if (folder / "bundle.json").is_file():
        raise UserError(
            f"{folder}: an exported folder, which generates and holds nothing else; name the run folder "
            f"(runs/NAME) that it was made from"
        )
    raise UserError(f"{folder}: not a run folder (no recipe.yaml)")
