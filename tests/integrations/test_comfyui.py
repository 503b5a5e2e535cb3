"""The nodes against a stand-in of ComfyUI's contract: declared types, a function by name, values
that fit the types.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import ROOT
from helpers.photos import metres, picture
from torch import Tensor
from torch.nn.functional import normalize

import spackle
from spackle.core.color import linear_to_srgb

FOLDER = ROOT / "integrations" / "comfyui"


@pytest.fixture(scope="module")
def nodes() -> dict[str, type]:
    """As ComfyUI loads a folder of custom_nodes."""
    spec = importlib.util.spec_from_file_location("custom_spackle", FOLDER / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert set(module.NODE_DISPLAY_NAME_MAPPINGS) == set(module.NODE_CLASS_MAPPINGS)
    found: dict[str, type] = module.NODE_CLASS_MAPPINGS
    return found


class Splat:
    """Has the arguments of ComfyUI's `Types.SPLAT`."""

    def __init__(
        self,
        positions: Tensor,
        scales: Tensor,
        rotations: Tensor,
        opacities: Tensor,
        sh: Tensor,
        counts: Tensor | None = None,
    ) -> None:
        self.positions, self.scales, self.rotations = positions, scales, rotations
        self.opacities, self.sh, self.counts = opacities, sh, counts


def fits(kind: object, value: Any) -> bool:
    """Whether a value is what ComfyUI passes along a link of that type."""
    shapes = {"IMAGE": 4, "MASK": 3}
    if isinstance(kind, str) and kind in shapes:
        right = (
            value.ndim == shapes[kind]
            and value.dtype == torch.float32
            and value.device.type == "cpu"
        )
        return bool(
            right
            and value.min() >= 0
            and value.max() <= 1
            and (kind == "MASK" or value.shape[-1] == 3)
        )
    plain: dict[str, type] = {
        "STRING": str,
        "INT": int,
        "FLOAT": float,
        "SPACKLE_SCENE": spackle.Scene,
        "SPLAT": Splat,
    }
    return (
        value in kind if isinstance(kind, list) else isinstance(value, plain.get(str(kind), object))
    )


def execute(node: Any, **values: Any) -> tuple[Any, ...]:
    """What ComfyUI's executor does: fill in defaults, check, call, unpack."""
    inputs = node.INPUT_TYPES()
    for name, (kind, *options) in {**inputs["required"], **inputs.get("optional", {})}.items():
        default = (
            options[0].get("default") if options else kind[0] if isinstance(kind, list) else None
        )
        if name in inputs["required"]:
            values.setdefault(name, default)
        assert name not in values or fits(kind, values[name]), name
    assert node.CATEGORY == "Spackle"
    result = getattr(node(), node.FUNCTION)(**values)
    if isinstance(result, dict):
        assert node.OUTPUT_NODE
        result = result["result"]
    assert len(result) == len(node.RETURN_TYPES)
    assert all(fits(kind, value) for kind, value in zip(node.RETURN_TYPES, result, strict=True))
    return tuple(result)


def test_a_workflow_from_an_image_to_views_and_a_file(
    nodes: dict[str, type], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = torch.from_numpy(picture()).float()[None] / 255
    inverse = (2 / torch.from_numpy(metres())).clamp(0, 1)[None, ..., None].expand(-1, -1, -1, 3)
    (base,) = execute(nodes["SpackleLoadBase"], name="lite")
    (alone,) = execute(nodes["SpacklePredictScene"], image=image, base=base)
    (scene,) = execute(
        nodes["SpacklePredictScene"],
        image=image,
        base=base,
        depth=inverse,
        near=2.0,
        far=6.0,
        fov=60.0,
    )
    assert scene.camera.focal[0] == pytest.approx(32 / torch.tensor(30.0).deg2rad().tan().item())
    assert scene.base.means[:, 2].median() == pytest.approx(6, rel=0.05)  # the wall
    assert alone.camera.focal[0] != scene.camera.focal[0]
    path = {"trajectory": "swipe", "disparity": 0.3}
    (whole,) = execute(nodes["SpackleCompleteScene"], scene=scene, **path)
    assert len(scene.aux) == 0 < len(whole.aux)
    before, open_holes, depth = execute(nodes["SpackleRenderView"], scene=scene, **path, frames=3)
    after, left, _ = execute(nodes["SpackleRenderView"], scene=whole, **path, frames=3)
    assert before.shape == after.shape == depth.shape == (3, 48, 64, 3)
    assert open_holes[0].mean() > 0.02 > 0.002 > left.mean()
    assert depth[1, 24, 32, 0] > 2 * depth[1, 2, 2, 0] > 0  # the box is nearer than the wall
    own = {"folder_paths": {"get_output_directory": lambda: str(tmp_path)}, "comfy_api": {}}
    own["comfy_api.latest"] = {"Types": SimpleNamespace(SPLAT=Splat)}
    for name, values in own.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    (splat,) = execute(nodes["SpackleToSplat"], scene=whole)
    count = len(whole.gaussians)
    shapes = [
        part.shape
        for part in (splat.positions, splat.scales, splat.rotations, splat.opacities, splat.sh)
    ]
    assert shapes == [(1, count, 3), (1, count, 3), (1, count, 4), (1, count, 1), (1, count, 1, 3)]
    seen = (0.5 + 0.28209479177387814 * splat.sh[0, :, 0]).clamp(0, 1)  # as ComfyUI shows it
    torch.testing.assert_close(seen, linear_to_srgb(whole.gaussians.colors), atol=1e-5, rtol=0)
    padded = Splat(
        *(torch.cat([p, p[:, :7]], dim=1) for p in vars(splat).values() if p is not None),
        torch.tensor([count]),
    )
    (back,) = execute(nodes["SpackleFromSplat"], splat=padded, width=64, height=48, fov=60.0)
    assert back.camera.focal[0] == pytest.approx(scene.camera.focal[0])
    unit = dataclasses.replace(whole.gaussians, quats=normalize(whole.gaussians.quats, dim=-1))
    for one, other in zip(back.gaussians.tensors, unit.tensors, strict=True):
        torch.testing.assert_close(one, other, atol=2e-5, rtol=1e-5)
    results = [
        execute(nodes["SpackleSaveScene"], scene=whole, name="../a", format=".ply")
        for _ in range(2)
    ]
    assert results[0][1].shape == (1, 48, 64, 3)
    files = [file for file, _ in results]
    assert [Path(file).relative_to(tmp_path).name for file in files] == [
        "a_00001.ply",
        "a_00002.ply",
    ]
    assert repr(spackle.Scene.load(files[1])) == repr(whole)
