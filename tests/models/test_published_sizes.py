"""Every network has as many parameters as its paper's settings make."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.condition.mate import Mate, MateConfig
from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.discriminator.patch import DiscriminatorConfig, PatchDiscriminator
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Stream
from motionloom.models.tokenizer.single import MqConfig
from motionloom.models.utt.network import Utt, UttConfig
from motionloom.pipeline.baselines.bailando.codes import DanceVq, DanceVqConfig
from motionloom.pipeline.baselines.bailando.network import ActorCritic, CrossGpt, CrossGptConfig, RewardConfig
from motionloom.pipeline.baselines.fact.network import Fact, FactConfig
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.baselines.mld.network import (
    LatentDenoiser,
    LatentDiffusionConfig,
    MotionVae,
    MotionVaeConfig,
)
from motionloom.pipeline.baselines.motionclip.network import MotionClip, MotionClipConfig, SixD
from motionloom.pipeline.baselines.motiondiffuse.network import MotionDiffuse, MotionDiffuseConfig
from motionloom.pipeline.baselines.tm2t.module import Critic
from motionloom.pipeline.baselines.tm2t.network import Captioner, CaptionerConfig
from motionloom.pipeline.baselines.tm2t.seq2seq import Seq2Seq, Seq2SeqConfig
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig

SMPL, H3D = MotionLayout.named("smpl75"), MotionLayout.named("h3d263")
CODE, TM2T = (Stream("code", 2048, 1),), (Stream("code", 1024, 1),)
BODY_HAND = (Stream("body", 512, 2), Stream("hand", 512, 1))


def bailando() -> nn.Module:
    return ActorCritic(CrossGpt(CrossGptConfig(), 512, 438), RewardConfig().critic_layers)


SIZES: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "GPT": (lambda: InterleavedGPT(GptConfig(), BODY_HAND, ("body", "body", "hand"), 256), 229_254_146),
    "TMA": (lambda: Tma(TmaConfig(), 313, 384), 14_543_417),
    "UDE's tokenizer": (lambda: MqConfig().build(SMPL), 33_056_843),
    "MATE": (lambda: Mate(MateConfig(), {"text": 512, "audio": 438}, timed=["audio"]), 4_984_064),
    "UTT": (lambda: Utt(UttConfig(), CODE, ("code",), glob_dim=256), 19_269_121),
    "UTT, GRU": (lambda: Utt(UttConfig(kind="gru"), CODE, ("code",), glob_dim=256), 15_062_529),
    "DMD": (lambda: Dmd(DmdConfig(), CODE, ("code",), 75), 36_349_003),
    "UDE's critic": (lambda: PatchDiscriminator(DiscriminatorConfig(), 75, 256), 28_912_641),
    "MDM": (lambda: Mdm(TextDenoiserConfig(), 263, 512), 17_880_327),
    "MotionDiffuse": (lambda: MotionDiffuse(MotionDiffuseConfig(), 263, 512), 87_152_135),
    "MotionCLIP": (lambda: MotionClip(MotionClipConfig(), 75, SixD(SMPL)), 16_900_608 + 25_312_406),
    "MLD's auto-encoder": (lambda: MotionVae(MotionVaeConfig(), 263), 18_032_135),
    # Without the published table [500, 1, 256] that is never read.
    "MLD": (lambda: LatentDenoiser(LatentDiffusionConfig(), 1, 768), 8_349_184 - 500 * 256),
    "TM2T's tokenizer": (lambda: Tm2tConfig().build(H3D), 17_844_224 + 23_043_233 + 1_048_576),
    "TM2T's critic": (lambda: Critic(263, 512), 1_065_985),
    # Rows of padding are none of ours.
    "TM2T's captioner": (lambda: Captioner(CaptionerConfig(), TM2T, ("code",), 4000), 31_998_976),
    "TM2T's text to motion": (lambda: Seq2Seq(Seq2SeqConfig(), TM2T, ("code",), 300), 16_952_832),
    "FACT": (lambda: Fact(FactConfig(columns="matrices"), SMPL, "all", music_dim=438), 120_406_977),
    "Bailando's codes": (lambda: DanceVq(DanceVqConfig(), 24), 65_068_619),
    "Bailando's GPT": (lambda: CrossGpt(CrossGptConfig(), 512, 438), 87_032_832),
    "Bailando": (bailando, 108_299_520),
}


@pytest.mark.parametrize("name", SIZES)
def test_parameters_of_the_published_settings(name: str) -> None:
    build, count = SIZES[name]
    with torch.device("meta"):
        assert sum(weight.numel() for weight in build().parameters()) == count
