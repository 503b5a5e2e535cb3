"""The script that makes weights for any use, in miniature: from models to files that are loaded."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
from made_models import MODELS, write_catalogue

pytest.importorskip("embreex", reason="needs research/worlds/requirements.txt")

import rebuild_open
from rebuild_open import Archives
from worlds import surfaces
from worlds.fetch import CATALOGUES

from spackle.bases.lite import load_networks
from spackle.residual.architectures import load_residual

pytestmark = pytest.mark.slow
LITE_DATA = Path(__file__).parents[2] / "lite" / "tests" / "lite_data.py"
SHORT = ("optim.steps=2", "optim.batch=2", "optim.warmup=0", "run.save_every=2")


def test_both_networks_are_made_from_models_and_open_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Models of boxes stand where `worlds.fetch` puts those of Debian, so nothing is downloaded.
    catalogues = tmp_path / "cache" / "root" / CATALOGUES
    catalogues.mkdir(parents=True)
    write_catalogue(catalogues / "Boxes.sh3f", MODELS)
    # Small textures, which are drawn quickly; the command finds their files.
    monkeypatch.setattr(surfaces, "SIDE", 64)
    for kind in surfaces.KINDS:
        surfaces.surfaces(tmp_path / "cache" / "surfaces", kind)
    monkeypatch.setenv("WORLDS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(
        rebuild_open,
        "ARCHIVES",
        (
            Archives("learned/photos", "rooms", worlds=2, views=1, seed=2),
            Archives("views", "rooms", worlds=9, views=7, seed=0),  # two archives
        ),
    )
    monkeypatch.setattr(rebuild_open, "HELD_ARCHIVES", {"worlds": 1})
    runpy.run_path(str(LITE_DATA))["write_data"](tmp_path)
    (tmp_path / "none.npz").write_text("not read: the miniature has no feature network")
    out = tmp_path / "out"
    arguments = [
        *("-o", str(out), "--photos", f"{tmp_path}/photos", "--office", f"{tmp_path}/kitchen"),
        *("--features", f"{tmp_path}/none.npz"),
        *("--lite", *SHORT, "data.made=2", "data.size=[64, 96]", "data.scales=[1]"),
        *("encoder=random", "run.validate_every=2"),
        *("--residual", *SHORT, "data.views=4", "data.validation_views=1", "data.cells=16"),
        *("loss.features=none", "loss.features_path=null", "run.validate_every=2"),
    ]
    assert rebuild_open.main(arguments) == 0
    (network,) = load_networks(out / "lite.safetensors")
    assert network.encoder.size == "lite2"
    assert load_residual(out / "residual.safetensors").name == "unet"

    held = {path.name for path in (out / "worlds" / "held").iterdir()}
    learned = {path.name for path in (out / "worlds" / "learned" / "views").iterdir()}
    assert held == {"worlds-00001.tar"}
    assert learned == {"worlds-00000.tar"}
    # Two photos of worlds and 20 links to each real one.
    real = len(list((tmp_path / "photos").iterdir()))
    assert len(list((out / "photos").iterdir())) == 2 + 20 * real

    # What is there is kept: the second call finds both runs at their end.
    written = (out / "lite" / "last.safetensors").stat().st_mtime_ns
    assert rebuild_open.main(arguments) == 0
    assert (out / "lite" / "last.safetensors").stat().st_mtime_ns == written
