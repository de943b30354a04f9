"""The stage kinds of the papers' rivals: which module registers each."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_KINDS = {
    "bailando": ("dance_vq", "cross_gpt", "actor_critic"),
    "fact": ("fact",),
    "mdm": ("mdm",),
    "mld": ("motion_vae", "latent_diffusion"),
    "motionclip": ("motionclip",),
    "motiondiffuse": ("motiondiffuse",),
    "tm2t": ("tm2t", "captioner", "seq2seq"),
}
"""Folder beside this file -> the kinds that its `stage` registers."""

for _folder, _names in _KINDS.items():
    declare("stage kind", dict.fromkeys(_names, f"motionloom.pipeline.baselines.{_folder}.stage"))
declare("stage kind", {"evaluate_captions": "motionloom.pipeline.baselines.tm2t.evaluate_captions"})
