"""Shared by the pipeline tests: a procedural walker to draw, the command line, a browser, one small run."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sysconfig
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.cli import main as cli

Joints = NDArray[np.float64]


def _walk(
    frames: int = 60, fps: float = 20.0, turn: float = 0.5, wave: bool = False, curl: float = 1.0
) -> Joints:
    skeleton = Skeleton.named("smplx52")
    t = np.arange(frames) / fps
    stride = np.sin(2 * np.pi * 0.9 * t)
    local = {name: Rotation.identity(frames) for name in skeleton.joints}

    def about(axis: str, angle: Any) -> Rotation:
        return Rotation.from_euler(axis, np.broadcast_to(np.asarray(angle, float), (frames,))[:, None])

    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * stride
        local[f"{side}_hip"] = about("x", -0.5 * swing)
        local[f"{side}_knee"] = about(
            "x", 0.25 + 0.45 * (1 + np.cos(2 * np.pi * 0.9 * t + (sign - 1) * np.pi / 2 + 0.5)) / 2
        )
        local[f"{side}_shoulder"] = about("x", 0.5 * swing) * about("z", -sign * 1.25)
        local[f"{side}_elbow"] = about("y", -sign * (0.45 + 0.2 * swing))
        for finger in ("index", "middle", "pinky", "ring"):
            bend = curl * (0.35 + 0.35 * np.sin(2 * np.pi * 0.5 * t))
            for k in (1, 2, 3):
                local[f"{side}_{finger}{k}"] = about("z", -sign * bend)
    if wave:
        local["left_shoulder"] = about("z", 0.75)
        local["left_elbow"] = about("z", 0.9 + 0.5 * np.sin(2 * np.pi * 1.6 * t))
    heading = turn * t
    local["pelvis"] = about("y", heading)
    turns = np.stack([local[name].as_matrix() for name in skeleton.joints], axis=1)
    joints, _ = forward_kinematics(turns, np.zeros((frames, 3)), skeleton.offsets, skeleton.parents)
    joints[..., 1] -= joints[:, 10:12, 1].min(axis=1)[:, None]
    speed = np.stack([np.sin(heading), 0 * t, np.cos(heading)], -1) * 1.1 / fps
    path = np.cumsum(speed, axis=0)
    return joints + (path - path[0])[:, None]


@pytest.fixture(scope="session")
def walk() -> Callable[..., Joints]:
    """`walk(frames, fps, turn, wave, curl) -> joints [T, 52, 3]` metres."""
    return _walk


@pytest.fixture(scope="session")
def face_track() -> Callable[[int], Joints]:
    """Face controls [T, 5] that smile, frown, blink and open the mouth in turn."""

    def track(frames: int) -> Joints:
        phase = np.linspace(0, 4 * np.pi, frames)
        smile, frown = np.clip(np.sin(phase), 0, 1), np.clip(-np.sin(phase), 0, 1)
        return np.stack(
            [
                smile,
                np.cos(phase),
                1 - 0.9 * (np.sin(5 * phase) > 0.97),
                np.clip(np.sin(2 * phase), 0, 1),
                frown,
            ],
            -1,
        )

    return track


PROGRAM = Path(sysconfig.get_path("scripts")) / "motionloom"

SMALL = """
extends: humantomato-tiny
name: small
seed: 3
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {clips: 48, min_seconds: 2.0, max_seconds: 5.0}
  tokenizer:
    net: {width: 24, depth: 1, code_dim: 16, num_codes: 32}
    train: {steps: 30, batch_size: 8, checkpoint_every: 6, validate_every: 12}
  face_tokenizer:
    net: {width: 16, depth: 1, code_dim: 16, num_codes: 16}
    train: {steps: 8, batch_size: 8, checkpoint_every: 5, validate_every: 5}
  tma:
    net: {latent: 32, ff: 64, layers: 1}
    train: {steps: 10, batch_size: 8, checkpoint_every: 5, validate_every: 10}
  tokens: {batch_frames: 64}
  gpt:
    net: {layers: 1, dim: 48, heads: 4, ff: 96}
    loss: {align_from: 10}
    train: {steps: 30, batch_size: 8, checkpoint_every: 6, validate_every: 12}
  face_gpt:
    net: {layers: 1, dim: 32, heads: 4, ff: 64}
    train: {steps: 8, batch_size: 8, checkpoint_every: 4, validate_every: 8, ema: 0.9}
  face_vae:
    {kind: tma, part: face, net: {latent: 32, ff: 64, layers: 1}, loss: {contrastive: 0},
     train: {steps: 8, batch_size: 8, checkpoint_every: 4, validate_every: 8}}
  face_diffusion:
    {kind: mdm, part: face, net: {dim: 32, ff: 64, layers: 1, heads: 4},
     train: {steps: 8, batch_size: 8, checkpoint_every: 4, validate_every: 8}}
  generate: {count: 1}
  evaluate: {clips: 6, repeats: 1, size: 4}
  report: {count: 1}
"""

UDE = """
extends: ude-tiny
name: ude-small
seed: 3
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {clips: 38, max_seconds: 5.0, dances: {songs: 8, song_seconds: 10.0}}
  tma: null
  tokenizer:
    net: {width: 16, code_dim: 16, num_codes: 32}
    train: {steps: 12, batch_size: 8, checkpoint_every: 4, validate_every: 6}
  utt:
    net: {layers: 1, dim: 32, heads: 2, ff: 64}
    mate: {dim: 32, layers: 1, heads: 2, ff: 32}
    loss: {adversarial_start: 4, adversarial_ramp: 4, discriminator: {dim: 16, ff: 32, heads: 2}}
    max_frames: 64
    train: {steps: 12, batch_size: 8, checkpoint_every: 4, validate_every: 6}
  dmd:
    net: {dim: 32, ff: 32, hide: 0.25, velocity_weight: 1.0, encoder_layers: 1, decoder_layers: 1, heads: 2}
    window: 64
    train: {steps: 8, batch_size: 8, checkpoint_every: 4, validate_every: 8}
  ude: {denoising_steps: 4, bridge_frames: 16}
"""


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """`call("data", "check", folder) -> Outcome`: a command in process, by its own entry point."""

    def go(*arguments: object) -> Outcome:
        monkeypatch.setattr("sys.argv", ["motionloom", *map(str, arguments)])
        monkeypatch.setenv("COLUMNS", "140")
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            cli.main()
        captured = capsys.readouterr()
        return Outcome(int(stop.value.code or 0), captured.out, captured.err)

    return go


@pytest.fixture(scope="session")
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """`start("run", recipe) -> Popen`: the installed program in a process group of its own."""
    started: list[subprocess.Popen[str]] = []

    def go(*arguments: object, program: tuple[object, ...] = (PROGRAM,)) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*map(str, program), *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "140"},
            start_new_session=True,
        )
        started.append(process)
        return process

    yield go
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
BROWSER_ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-3d-apis",  # sticks, which are quick; the page's WebGL2 view has tests of its own
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser_arguments() -> list[str]:
    """How Chromium is started; a module may have its own."""
    return BROWSER_ARGUMENTS


@pytest.fixture(scope="module")
def browser(browser_arguments: list[str]) -> Iterator[Any]:
    """A headless Chromium; skips where there is none."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine to drive")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=browser_arguments)
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def until() -> Callable[..., None]:
    """`until(page, expression)`: wait for JavaScript, from outside: the page's own policy forbids `eval`."""

    def go(page: Any, expression: str, seconds: float = 15.0) -> None:
        end = time.monotonic() + seconds
        while not page.evaluate(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            page.wait_for_timeout(20)

    return go


@dataclass(frozen=True)
class SmallRun:
    """A finished run: its recipe, its folder (not to be changed) and what the program printed."""

    recipe: Path
    folder: Path
    output: str


def run_once(
    factory: pytest.TempPathFactory, name: str, content: str, start: Callable[..., Any], *options: object
) -> SmallRun:
    """The finished run of a recipe; the first of the test processes that needs it makes it for all."""
    base = factory.getbasetemp()
    root = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "runs" / name
    root.mkdir(parents=True, exist_ok=True)
    recipe, folder, log = root / f"{name}.yaml", root / "run", root / "log"
    with (root / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not log.is_file():
            recipe.write_text(content)
            process = start("run", recipe, "--out", folder, *options)
            output, _ = process.communicate(timeout=240)
            assert process.returncode == 0, output
            log.write_text(output)
    return SmallRun(recipe, folder, log.read_text())


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory, start: Callable[..., Any]) -> SmallRun:
    """Every stage of a small recipe."""
    return run_once(tmp_path_factory, "small", SMALL, start)


@pytest.fixture(scope="session")
def ude_run(tmp_path_factory: pytest.TempPathFactory, start: Callable[..., Any]) -> SmallRun:
    """A small UDE, text or music to motion, up to the stage that generates."""
    return run_once(tmp_path_factory, "ude-small", UDE, start, "--until", "ude")
