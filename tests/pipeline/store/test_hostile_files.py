"""Files from strangers run nothing: every reader refuses a payload in a sentence, and no marker appears.

Converters, the restricted unpickler, tars and URLs have such tests beside them; here are the files of runs,
exports, caches, text encoders and recipes. What recipes may name is in `runs/test_recipe.py`.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import os
import pickle
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.common.arrays import load_array
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.shards.index import read_index
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import captions_from_json
from motionloom.datasets.text.cache import CacheInfo, TextCache
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.contract.lookup import open_exported
from motionloom.pipeline.evaluation.diagnosis import showings
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.tokens import TokenStore
from motionloom.pipeline.store.weights import load_weights
from motionloom.pipeline.training.checkpointing import readable, write_checkpoint

MARKER = "PWNED"


class Payload:
    """Runs a shell command wherever it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return os.system, (f"touch {MARKER}",)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty current folder, in which a payload would leave its marker."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    yield folder
    assert not list(folder.iterdir()), "a payload ran"


def test_the_payload_is_live(here: Path) -> None:
    pickle.loads(pickle.dumps(Payload()))
    (here / MARKER).unlink()


def zipped(content: object) -> bytes:
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()


def objects(shape: tuple[int, ...]) -> bytes:
    out = io.BytesIO()
    values = np.empty(shape, dtype=object)
    values.fill(Payload())
    np.save(out, values, allow_pickle=True)
    return out.getvalue()


def archive(*names: str) -> bytes:
    out = io.BytesIO()
    values = np.array([Payload()], dtype=object)
    np.savez(out, allow_pickle=True, **dict.fromkeys(names, values))
    return out.getvalue()


def sealed(content: bytes) -> bytes:
    """With the seal that our writer would give it: it is no signature."""
    return content + f"\nmotionloom sha256 {hashlib.sha256(content).hexdigest()}\n".encode()


# --- checkpoints -----------------------------------------------------------------------------------------

CHECKPOINTS = {
    "a pickle": lambda: pickle.dumps({"state_dict": Payload()}),
    "a pickle of protocol 0": lambda: pickle.dumps(Payload(), protocol=0),
    "torch's archive": lambda: zipped({"state_dict": {"net.weight": Payload()}, "global_step": 40}),
    "torch's archive, sealed": lambda: sealed(zipped({"state_dict": Payload(), "sealed": True})),
    "a pickle, sealed": lambda: sealed(pickle.dumps({"state_dict": Payload(), "sealed": True})),
}


@pytest.mark.parametrize("name", ["step=00000040.ckpt", "last.ckpt"])
@pytest.mark.parametrize("make", CHECKPOINTS.values(), ids=CHECKPOINTS.keys())
def test_checkpoints_with_code_are_passed_over(make: Callable[[], bytes], name: str, tmp_path: Path) -> None:
    write_checkpoint({"global_step": 20}, tmp_path / "step=00000020.ckpt")
    (tmp_path / name).write_bytes(make())
    said: list[str] = []
    found = [(path.name, content["global_step"]) for path, content in readable(tmp_path, said.append)]
    assert found == [("step=00000020.ckpt", 20)]
    assert len(said) == 1 and said[0].startswith(f"{tmp_path / name}: ")


# --- weights, statistics, tokens -------------------------------------------------------------------------

SAFETENSORS: dict[str, Callable[[Path], object]] = {
    "cases.safetensors": lambda path: showings(
        path.parent, {"skeleton": "smplx52", "fps": 20, "actions": {}, "cases": [{"of": "generated"}]}
    ),
    "model.safetensors": lambda path: load_weights(path.parent, torch.nn.Linear(2, 2)),
    "stats.safetensors": FeatureStats.load,
    "audio.safetensors": FrameStats.load,
    "tokens-train.safetensors": lambda path: TokenStore.load(path, {"body": 1}),
}
DISGUISES = {
    "a pickle": lambda: pickle.dumps(Payload()),
    "torch's archive": lambda: zipped({"weight": Payload()}),
    "a header of 2^62 bytes": lambda: (2**62).to_bytes(8, "little") + b"{}",
    "a tensor of 2^60 bytes": lambda: _claims([2**60]),
}


def _claims(shape: list[int]) -> bytes:
    header = json.dumps({"weight": {"dtype": "U8", "shape": shape, "data_offsets": [0, shape[0]]}}).encode()
    return len(header).to_bytes(8, "little") + header


@pytest.mark.parametrize("make", DISGUISES.values(), ids=DISGUISES.keys())
@pytest.mark.parametrize("name", SAFETENSORS)
def test_what_stands_for_safetensors_is_refused(name: str, make: Callable[[], bytes], tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(make())
    with pytest.raises(UserError, match=name):
        SAFETENSORS[name](path)


# --- arrays ----------------------------------------------------------------------------------------------


def text_cache(folder: Path, bad: str) -> Path:
    """A text cache of one caption, one of whose arrays is a payload."""
    (folder / "cache.json").write_text(json.dumps({"encoder": "x:0", "dim": 3, "count": 1}))
    arrays = {"keys": np.zeros((1, 32), np.uint8), "sentence": np.zeros((1, 3)), "offsets": np.arange(2),
              "tokens": np.zeros((1, 3))}  # fmt: skip
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", values)
    (folder / f"{bad}.npy").write_bytes(objects(arrays[bad].shape))
    return folder


ARRAYS: dict[str, Callable[[Path], object]] = {
    "a motion's columns": lambda f: load_array(put(f, "a.npy", objects((4, 3))), width=3),
    "a release's statistics": lambda f: FeatureStats.of_arrays(
        put(f, "mean.npy", objects((263,))), f / "std.npy", MotionLayout.named("h3d263")
    ),
    "a body's poses": lambda f: NpzFile(put(f, "a.npz", archive("poses"))).numbers("poses"),
    "a body model": lambda f: BodyModel.load(put(f, "model.npz", archive("kintree_table")), "smpl22"),
    "a body model's pickle": lambda f: BodyModel.load(put(f, "model.pkl", pickle.dumps(Payload())), "smpl22"),
    "an index of shards": lambda f: read_index(
        io.BytesIO(archive("train.frames", "train.data")), "index.npz", "train", []
    ),
    **{
        f"a text cache's {name}": lambda f, name=name: TextCache.open(text_cache(f, name))
        for name in ("keys", "sentence", "offsets", "tokens")
    },
}


def put(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("read", ARRAYS.values(), ids=ARRAYS.keys())
def test_arrays_of_objects_are_refused(read: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(UserError):
        read(tmp_path)


# --- recipes ---------------------------------------------------------------------------------------------

TAGS = (
    "!!python/object/apply:os.system ['touch PWNED']",
    "!!python/object/new:os.system ['touch PWNED']",
    "!!python/object/apply:subprocess.check_output [[touch, PWNED]]",
    "!!python/module:antigravity ''",
)


@pytest.mark.parametrize("tag", TAGS)
def test_recipes_with_tags_are_refused(tag: str, tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(f"name: x\nstages: {{data: {{kind: synth, clips: {tag}}}}}\n")
    with pytest.raises(UserError, match=r"recipe\.yaml: not valid YAML"):
        load_recipe(path)
    path.write_text(f"extends: humantomato-tiny\nname: {tag}\n")
    with pytest.raises(UserError, match=r"recipe\.yaml: not valid YAML"):
        load_recipe(path)
    with pytest.raises(UserError, match=r"--set data\.clips=.*: not valid"):
        load_recipe("humantomato-tiny", [f"data.clips={tag}"])


def test_nesting_without_end_is_refused(tmp_path: Path) -> None:
    deep = "[" * 100_000
    files = {"recipe.yaml": f"name: x\nstages: {deep}", "manifest.json": deep, "bundle.json": deep}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    for read in (
        lambda: load_recipe(tmp_path / "recipe.yaml"),
        lambda: ShardDataset.open(tmp_path, "train"),
        lambda: open_exported(tmp_path),
        lambda: CacheInfo.load_json(tmp_path / "manifest.json"),
        lambda: captions_from_json(deep.encode(), "a.texts.json"),
    ):
        with pytest.raises(UserError):
            read()


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(9 * [f'*{chr(97 + k)}'])}]\n" for k in range(9)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BOMB, "more than 20,000 values"),
        ("name: x\nstages:\n" + "".join(f"  s{k}: {{kind: stats}}\n" for k in range(20_000)), "longer than"),
        ("name: x\nstages: {data: &d {kind: synth, clips: *d}}", "recipe.yaml"),
        ("name: x\n" + "#" * 10**7, "longer than"),
    ],
    ids=["a bomb", "20,000 stages", "an alias of itself", "10 MB"],
)
def test_recipes_without_end_are_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "recipe.yaml").write_text(text)
    with pytest.raises(UserError, match=said):
        load_recipe(tmp_path / "recipe.yaml")


# --- text encoders ---------------------------------------------------------------------------------------

CODE = f"import pathlib\npathlib.Path({MARKER!r}).touch()\nclass Evil: pass\n"
PICKLED = zipped({"linear.weight": Payload()})
ENCODERS: dict[str, dict[str, str | bytes]] = {
    "code named by modules.json": {
        "modules.json": json.dumps([{"idx": 0, "name": "0", "path": "", "type": "evil.Evil"}]),
        "evil.py": CODE,
    },
    "code named by config.json": {
        "config.json": json.dumps({
            "model_type": "evil", "auto_map": {"AutoConfig": "evil.Evil", "AutoModel": "evil.Evil"}
        }),
        "evil.py": CODE,
    },
    "pickled weights": {
        "config.json": json.dumps({
            "model_type": "bert", "hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1,
            "intermediate_size": 8, "vocab_size": 9,
        }),
        "pytorch_model.bin": PICKLED,
    },
    "a module's pickled weights and function": {
        "modules.json": json.dumps([
            {"idx": 0, "name": "0", "path": "dense", "type": "sentence_transformers.models.Dense"}
        ]),
        "dense/config.json": json.dumps({
            "in_features": 2, "out_features": 2, "activation_function": "evil.Evil"
        }),
        "dense/pytorch_model.bin": PICKLED,
        "evil.py": CODE,
    },
}  # fmt: skip


@pytest.mark.parametrize("files", ENCODERS.values(), ids=ENCODERS.keys())
def test_text_encoders_bring_no_code(
    files: dict[str, str | bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "encoder"
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    monkeypatch.syspath_prepend(str(folder))  # as where Python is started in that folder
    with pytest.raises(UserError, match="encoder: "):
        load_text_encoder(str(folder))


# --- the code --------------------------------------------------------------------------------------------

ROOT = Path(__file__).resolve().parents[3]
NEVER = re.compile(
    r"(os\.(system|popen|exec\w+|spawn\w+)|pickle\.loads?|pickle\.Unpickler|marshal\.loads?|shelve\.open|eval|exec"
    r"|yaml\.(unsafe_|full_)?load(_all)?|joblib\.load|dill\.loads?|[\w.]+\.(extract|extractall|unpack_archive))"
)
ONLY_WITH = {
    "np.load": ("allow_pickle", False), "numpy.load": ("allow_pickle", False),
    "npy_format.read_array": ("allow_pickle", False), "torch.load": ("weights_only", True),
}  # fmt: skip
KNOWN = {("pipeline/store/yaml.py", "yaml.load")}
"""With a loader of plain data."""


def test_the_code_has_no_other_way_to_run_a_file() -> None:
    """Every call that could is absent, or says that it must not."""
    seen = 0
    for path in sorted(
        p for f in ("configs", "datasets", "models", "pipeline") for p in (ROOT / f).rglob("*.py")
    ):
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            call = ast.unparse(node.func)
            given = {word.arg: getattr(word.value, "value", None) for word in node.keywords}
            where = f"{name}:{node.lineno}: {call}"
            assert not NEVER.fullmatch(call) or (name, call) in KNOWN, where
            assert given.get("shell") is not True and given.get("trust_remote_code") is not True, where
            if call in ONLY_WITH:
                key, value = ONLY_WITH[call]
                assert given.get(key) is value, where
                seen += 1
    assert seen > 5, "the names above are those of no call"
