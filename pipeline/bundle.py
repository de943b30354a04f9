"""Everything that turns a caption into motion: text encoder, TMA, GPT, tokenizer, statistics, face line.

A bundle opens from a run folder or from an exported one; both hold one folder per part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.features import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.shards.statistics import FeatureStats
from motionloom.datasets.text.encoder import EncodedText, TextEncoder, load_text_encoder
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.sampling import generate, sample_seeds
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.artifact import Artifact
from motionloom.pipeline.faces import FaceGenerator, FaceKind, FaceRequest, choose, expression, load_faces
from motionloom.pipeline.model_store import LayoutFacts
from motionloom.pipeline.networks import LoadedTma, load_gpt, load_tokenizer
from motionloom.pipeline.sampling import SamplingConfig

PARTS = (
    "stats", "text", "tokenizer", "tma", "gpt", "face_tokenizer", "face_gpt", "face_vae", "face_diffusion",
)  # fmt: skip
REQUIRED = ("stats", "tokenizer", "gpt")


class BundleFile(Config):
    """`bundle.json` of an exported folder."""

    layout: LayoutFacts
    text_encoder: str


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
    """The parts, loaded once."""

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
    def open(folder: Path) -> Bundle:
        """Open a run folder or an exported folder."""
        if (folder / "bundle.json").is_file():
            facts = BundleFile.load_json(folder / "bundle.json")
            own = folder / facts.text_encoder
            encoder = str(own) if own.is_dir() else facts.text_encoder
            return Bundle.from_parts({p: folder / p for p in PARTS if (folder / p).is_dir()}, encoder)
        return Bundle.from_run(folder)

    @staticmethod
    def from_run(run: Path) -> Bundle:
        """Open the finished stages of a run."""
        parts = part_folders(run)
        if "text" not in parts:
            raise UserError(f"{run}: no finished text stage; run the recipe to the end first")
        return Bundle.from_parts(parts, text_encoder_of(parts["text"]))

    @staticmethod
    def from_parts(parts: dict[str, Path], text_encoder: str) -> Bundle:
        """Open one folder per part."""
        for role in REQUIRED:
            if role not in parts:
                raise UserError(f"no finished '{role}' stage here; run the recipe to the end first")
        tokenizer = load_tokenizer(parts["tokenizer"])
        gpt, prior = load_gpt(parts["gpt"], tokenizer)
        return Bundle(
            layout=tokenizer.layout,
            stats=FeatureStats.load(parts["stats"] / "stats.safetensors"),
            text_encoder_name=text_encoder,
            tokenizer=tokenizer,
            gpt=gpt,
            prior=prior,
            tma=LoadedTma.load(parts["tma"]) if "tma" in parts else None,
            faces=load_faces(parts),
        )

    @cached_property
    def text_encoder(self) -> TextEncoder:
        """Loaded on first use; it is the slow part of starting."""
        return load_text_encoder(self.text_encoder_name)

    @property
    def max_seconds(self) -> float:
        """Longest motion the GPT's block holds."""
        return self.max_groups * self.tokenizer.group_frames / self.layout.fps

    @property
    def max_groups(self) -> int:
        """Longest motion in groups of four frames."""
        return self.gpt.max_groups

    def generate(
        self,
        captions: Sequence[str],
        *,
        face_captions: Sequence[str] | None = None,
        seconds: float | None = None,
        seed: int = 0,
        sampling: SamplingConfig | None = None,
        batch: int = 64,
    ) -> list[GeneratedMotion]:
        """Motions for captions, in order; the same seed and caption give the same motion."""
        faces = list(face_captions) if face_captions is not None else list(captions)
        if len(faces) != len(captions):
            raise UserError(f"{len(captions)} captions but {len(faces)} face captions")
        sampling = sampling or SamplingConfig()
        # One seed a motion, so that how they are batched plays no part.
        seeds = sample_seeds(seed, 2 * len(captions))
        out: list[GeneratedMotion] = []
        for start in range(0, len(captions), batch):
            part = slice(start, start + batch)
            both = seeds[: len(captions)][part], seeds[len(captions) :][part]
            out += self._batch(list(captions[part]), faces[part], seconds, both, sampling)
        return out

    def _batch(
        self,
        captions: list[str],
        faces: list[str],
        seconds: float | None,
        seeds: tuple[list[int], list[int]],
        sampling: SamplingConfig,
    ) -> list[GeneratedMotion]:
        groups = self._groups(seconds, len(captions))
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

    def _groups(self, seconds: float | None, count: int) -> Tensor | None:
        if seconds is None:
            return None
        groups = round(seconds * self.layout.fps / self.tokenizer.group_frames)
        if not 1 <= groups <= self.max_groups:
            raise UserError(
                f"{seconds:g} s is out of reach: this model makes 0.2 to {self.max_seconds:.1f} s"
            )
        return torch.full((count,), groups)

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
        """The GPT's text priors [n, E]."""
        encoded = self.text_encoder.encode(texts)
        return torch.as_tensor(encoded.sentence) if self.prior == "sentence" else self._tma_text(encoded)

    def _tma_text(self, encoded: EncodedText) -> Tensor:
        if self.tma is None:
            raise UserError("this GPT needs the TMA text encoder, and no tma part is here")
        return self.tma.embed_text(torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask))

    def _decode(self, codes: dict[str, Tensor], groups: Tensor) -> list[NDArray[np.float32]]:
        """Features in their own units, [T, D] a sample; each is decoded alone, so padding plays no part."""
        streams, columns = self.tokenizer.streams, self.tokenizer.columns.numpy()
        out = []
        for row, count in enumerate(groups.tolist()):
            single = {s.name: codes[s.name][row : row + 1, : count * s.per_group] for s in streams}
            with torch.no_grad():
                motion = self.tokenizer.decode(single)[0].numpy()
            out.append((motion * self.stats.std[columns] + self.stats.mean[columns]).astype(np.float32))
        return out


def part_folders(run: Path) -> dict[str, Path]:
    """Folder of each part in a run: as its `generate` stage names them, else by the part's own name."""
    recipe = _resolved(run)
    stages = recipe["stages"]
    roles = {part: part for part in PARTS if part in stages}
    for entry in stages.values():
        if entry["kind"] == "generate":
            roles.update({r: s for r, s in entry.get("inputs", {}).items() if r in PARTS})
    found = {role: run / "stages" / stage for role, stage in roles.items() if stage}
    return {role: folder for role, folder in found.items() if (folder / "artifact.json").is_file()}


def text_encoder_of(text_folder: Path) -> str:
    """Name of the text encoder a text stage used."""
    artifact = Artifact.find(text_folder)
    if artifact is None:
        raise UserError(f"{text_folder}: the text stage has not finished")
    return str(artifact.config["encoder"])


def _resolved(run: Path) -> dict[str, dict]:
    path = run / "recipe.yaml"
    if not path.is_file():
        raise UserError(f"{run}: not a run folder (no recipe.yaml) and not an exported one (no bundle.json)")
    data: dict[str, dict] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return data
