"""The first ten minutes on a machine with an NVIDIA GPU: a report in Markdown on what works, how
exactly, how fast.

python benchmarks/gpu.py [-o gpu.md] [-c SHARP.pt] [--only STEP,...]

Each step runs in its own process, because a fault in a kernel ends the process, and the report
states what the step must show. A step that cannot run here is skipped with its reason; without a
GPU this applies to all, as a dry run. The file is rewritten after each step and is meant for
docs/performance.md. `benchmarks/random_weights.py sharp.pt` makes weights for -c.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from suite_scenes import SIDE, commit, find_view, holed_scene, photo_scene
from torch.utils._python_dispatch import TorchDispatchMode

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric
from spackle.cli.script_command import run_script
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo
from spackle.core.trajectories import (
    DepthRange,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.paper.evaluation.bench import TOTAL_STAGE, TimedTask, time_tasks
from spackle.paper.training.losses import total_loss
from spackle.paper.training.recipe import LossRecipe
from spackle.paper.training.residual import complete_samples
from spackle.paper.training.samples import Sample
from spackle.render import CpuRenderer
from spackle.render.drawing import project, tiles_to_draw
from spackle.render.gsplat_backend import DeviceGaussians, GsplatRenderer, load_gsplat
from spackle.render.project import KernelCamera
from spackle.render.protocol import TILE_PX, Rendering, near_plane
from spackle.residual import hole_area_ratio
from spackle.residual.architectures import shipped_network
from spackle.runtime.device import Precision, hardware_facts, package_versions
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_file, check_writable, write_atomic
from spackle.runtime.parallel_kernels import device_for_kernels
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.unet import UNet

REPOSITORY = Path(__file__).parents[1]
SKIPPED, LIMIT_S, RUNS = 77, 1200, 20
CUDA = torch.device("cuda")
CLOSE = 2e-4  # smaller differences in sRGB count as equal
TESTS = "tests/render/test_gsplat_backend.py"
CROP, BATCH = 96, 8  # cells along a training crop; crops per step
TENTH_HOLES = 0.1  # HAR of the paper's efficiency figure


class Skip(Exception):  # not an error
    """Raised with the reason why a step cannot run here."""


def renderer() -> GsplatRenderer:
    """The GPU renderer; raises `Skip` with what is missing."""
    try:
        return GsplatRenderer()
    except InputError as error:
        raise Skip(str(error)) from error


def run(*command: str) -> Iterator[str]:
    """Yield the lines that a program prints; the step fails if the program fails."""
    if shutil.which(command[0]) is None:
        raise Skip(f"there is no {command[0]} on the path")
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)
    if done.returncode:
        raise SystemExit(
            f"{' '.join(command)} ended with "
            f"{done.returncode}:\n{(done.stdout + done.stderr)[-2000:]}"
        )
    yield from done.stdout.splitlines()


def sharp(options: argparse.Namespace, precision: Precision = "fp32") -> tuple[SharpBase, Photo]:
    """Load SHARP on the GPU, and make a photo of noise."""
    if not torch.cuda.is_available():
        raise Skip("PyTorch sees no NVIDIA GPU on this machine")
    if options.checkpoint is None:
        raise Skip("no weights: give -c FILE")
    photo = Photo(
        torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0)),
        1843.2,
        FocalSource.DATASET,
        Path("photo.png"),
    )
    base = SharpBase.load(options.checkpoint, precision=precision, device=CUDA)
    return base, photo


def views() -> tuple[Gaussians, list[Camera]]:
    """A scene of SHARP's size, the photo's camera, and a camera to its side."""
    scene, camera = photo_scene()
    return scene, [
        camera,
        leftmost_and_rightmost(camera, 0.3, DepthRange.of(scene, is_metric=True))[1],
    ]


def rows(tasks: dict[str, TimedTask], runs: int = RUNS) -> Iterator[str]:
    """Yield a table of the tasks' median milliseconds; the tasks take turns."""
    yield from ("", "| what | median |", "|---|---|")
    for (name, stage), times in time_tasks(runs, tasks, CUDA).items():
        if stage == TOTAL_STAGE:
            low, median, high = (
                torch.from_numpy(times).quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
            )
            yield f"| {name} | {median:,.2f} ms ({low:,.2f} – {high:,.2f}) |"


def machine(options: argparse.Namespace) -> Iterator[str]:
    """names driver, GPU, torch and the compiler"""
    sees_gpu = torch.cuda.is_available()
    yield f"torch {torch.__version__}, CUDA {torch.version.cuda}, sees a GPU: {sees_gpu}"
    yield from run(
        "nvidia-smi", "--query-gpu=name,driver_version,memory.total,compute_cap", "--format=csv"
    )
    yield from list(run("nvcc", "--version"))[-2:]


def build(options: argparse.Namespace) -> Iterator[str]:
    """gsplat's kernels build and load; loading them again takes seconds"""
    if importlib.util.find_spec("gsplat") is None:
        raise Skip("gsplat is not installed: pip install 'spackle-nvs[cuda]'")
    start = time.perf_counter()
    try:
        package = load_gsplat(CUDA)
    except InputError as error:
        raise Skip(str(error)) from error
    yield f"gsplat {package.__version__}: {time.perf_counter() - start:.1f} s"


def empty(options: argparse.Namespace) -> Iterator[str]:
    """an empty scene renders black, and an empty set added to another changes nothing"""
    gpu = renderer()
    scene, camera = photo_scene(256)
    black, alone, both = (gpu.render(s, camera) for s in ([], [scene], [scene, Gaussians.empty()]))
    same = all(torch.equal(a, b) for a, b in zip(alone.tensors, both.tensors, strict=True))
    yield f"black: {not any(bool(t.any()) for t in black.tensors)}; the same bits: {same}"


def parity(options: argparse.Namespace) -> Iterator[str]:
    """all tests of values, gradients, tiles, batches and memory pass, and none of gsplat's is
    skipped
    """
    renderer()
    yield list(run(sys.executable, "-m", "pytest", TESTS, "-q", "-rs"))[-1]


def against_cpu(options: argparse.Namespace) -> Iterator[str]:
    """with eps2d 0 nearly all pixels are within 2e-4 of the CPU's, and hardly any Gaussian is drawn
    by one alone
    """
    gpu = renderer()
    scene, cameras = views()
    for camera in cameras:
        by_gpu = gpu.render(scene, camera)
        by_cpu = CpuRenderer().render(scene, camera)
        difference = (by_gpu.rgb - by_cpu.rgb).abs().amax(-1)  # [H, W]

        # Which Gaussians each of the two draws.
        near = near_plane([scene], camera)
        material = DeviceGaussians.of(scene, CUDA)
        view = camera.to(CUDA)
        radii = gpu._gsplat.fully_fused_projection(
            material.means,
            material.covariances,
            None,
            None,
            view.world_to_camera[None],
            view.K[None],
            camera.width,
            camera.height,
            eps2d=0.0,
            near_plane=near,
            opacities=material.opacities,
        )[0][0]
        drawn_by_gpu = (radii > 0).all(-1).cpu()
        lens = KernelCamera.of(camera, 0.0, near)
        # The column after a Gaussian's last tile is 0 if it is not drawn.
        boxes = project([scene], lens, tiles_to_draw(lens, None)).boxes
        drawn_by_cpu = torch.from_numpy(boxes[:, 1] > 0)
        yield (
            f"{len(scene):,} Gaussians: {float((difference < CLOSE).float().mean()):.4%} of pixels "
            f"within {CLOSE:g}, worst {float(difference.max()):.1e}; "
            f"drawn by the GPU alone {int((drawn_by_gpu & ~drawn_by_cpu).sum()):,}, "
            f"by the processor alone {int((drawn_by_cpu & ~drawn_by_gpu).sum()):,}"
        )


def sanitizer(options: argparse.Namespace) -> Iterator[str]:
    """no invalid memory access in forward and backward passes, with tiles and batches"""
    renderer()
    words = "gradients or tiles or together or batch"
    command = ["compute-sanitizer", "--tool", "memcheck", "--error-exitcode", "1"]
    yield list(run(*command, sys.executable, "-m", "pytest", TESTS, "-q", "-k", words))[-1]


def counted_waits(call: Callable[[], object]) -> list[str]:
    """The lines of code where a call makes the host wait for the GPU; the call runs once before, to
    warm up.
    """
    call()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    found = [each for each in caught if "synchroniz" in str(each.message)]
    return [f"{Path(each.filename).name}:{each.lineno}" for each in found]


def waits(options: argparse.Namespace) -> Iterator[str]:
    """the host waits for the GPU only at the end: to get the five tensors of the scene"""
    base, photo = sharp(options)
    places = counted_waits(lambda: base.predict(photo))
    yield f"{len(places)} waits: {', '.join(places)}"


def precisions(options: argparse.Namespace) -> Iterator[str]:
    """bf16 is several times as fast as fp32 and gives nearly the same results"""
    tasks: dict[str, TimedTask] = {}
    found: dict[str, torch.Tensor] = {}
    names: list[Precision] = ["fp32", "bf16"]
    for name in names:
        base, photo = sharp(options, name)
        found[name] = to_metric(base.infer(photo), photo).means
        tasks[name] = lambda _, base=base, photo=photo: base.predict(photo)  # type: ignore[misc]
    for precision, means in found.items():
        apart = (means - found["fp32"]).norm(dim=-1) / found["fp32"].norm(dim=-1)
        yield f"{precision}: centres {float(apart.median()):.1e} (relative median) from fp32's"
    yield from rows(tasks, 5)


def speed(options: argparse.Namespace) -> Iterator[str]:
    """a view of 1.2 M Gaussians at 1536² takes 3 ms at most"""
    gpu, (scene, cameras) = renderer(), views()
    there, eyes = scene.to(CUDA), itertools.cycle(cameras)
    few = Gaussians(*(t[:30_000].contiguous() for t in there.tensors))
    tiles = torch.zeros(SIDE // TILE_PX, SIDE // TILE_PX, dtype=torch.bool, device=CUDA)
    tiles[:24, :24] = True

    def again(_: object) -> None:  # as in completion
        view: Rendering = gpu.render(there, cameras[0])
        gpu.render([there, few], cameras[0], tiles=tiles, previous_rendering=view)

    yield from rows(
        {
            "view: scene on the GPU, another camera each turn": lambda _: gpu.render(
                there, next(eyes)
            ),
            "view, and some of its tiles once more with 30,000 Gaussians": again,
            "8 views in one batch": lambda _: gpu.render_batch([[there]] * 8, cameras * 4),
            "view: the scene comes from the processor, the picture goes back": lambda _: gpu.render(
                Gaussians(*(t.clone() for t in scene.tensors)), cameras[0]
            ),
        }
    )
    yield f"\n{torch.cuda.max_memory_allocated() / 2**30:.1f} GiB of the GPU's memory at most"


def training(options: argparse.Namespace) -> Iterator[str]:
    """a step with loss and gradients takes a twentieth of its time on the CPU, and waits for the
    GPU once
    """
    gpu = renderer()
    scene, camera = holed_scene(768)
    view = find_view(scene, camera, gpu)[1]
    photo, target = torch.rand(2, view.height, view.width, 3)
    whole = Sample.of(scene, CpuRenderer().render(scene, view), view, camera, photo, target)
    cells = whole.features.mask[:-CROP, :-CROP].nonzero()
    picked = cells[torch.linspace(0, len(cells) - 1, BATCH).long()].tolist()
    crops = [
        whole.crop(max(row - CROP // 2, 0), max(column - CROP // 2, 0), CROP, CROP)
        for row, column in picked
    ]

    def task(device: torch.device, drawer: GsplatRenderer | CpuRenderer) -> Callable[[], object]:
        network = UNet().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]

        def step() -> None:
            done = complete_samples(network, network.inputs, crops, drawer)
            tensors = {
                name: tensor.to(device, non_blocking=True) for name, tensor in vars(done).items()
            }
            total_loss(**tensors, recipe=LossRecipe())[0].backward()  # type: ignore[no-untyped-call]

        return step

    here = task(CUDA, gpu)
    places = counted_waits(here)
    yield f"{len(places)} waits: {', '.join(places)}"
    there = task(torch.device("cpu"), CpuRenderer())
    yield from rows(
        {f"GPU: {BATCH} crops of {2 * CROP}²": lambda _: here(), "processor": lambda _: there()}, 5
    )


def completion(options: argparse.Namespace) -> Iterator[str]:
    """a view completed on the GPU looks the same as on the CPU, has as few holes, and takes less
    time
    """
    gpu = renderer()
    scene, camera = holed_scene()
    view = find_view(scene, camera, gpu)[1]
    contexts = [
        FillContext(scene, camera, drawer, shipped_network()) for drawer in (gpu, CpuRenderer())
    ]
    found = [fill_view(context, view).aux for context in contexts]
    one, other = (CpuRenderer().render([scene, aux], view) for aux in found)
    apart = float((one.rgb - other.rgb).abs().mean())
    yield (
        f"{len(found[0]):,} and {len(found[1]):,} Gaussians; mean difference {apart:.1e}; "
        f"holes {hole_area_ratio(one.alpha):.3%} and {hole_area_ratio(other.alpha):.3%}"
    )
    placed, guard = contexts[0].on_renderer_device, contexts[0].photo_guard()
    before = gpu.render(placed.base, view)
    places = counted_waits(lambda: fill_view(placed, view, [guard], before))
    yield f"{len(places)} waits: {', '.join(sorted(set(places)))}"
    empty_view = before.to(torch.device("cpu"))
    yield from rows(
        {
            "added time on the GPU": lambda _: fill_view(placed, view, [guard], before),
            "on the processor": lambda _: fill_view(contexts[1], view, [guard], empty_view),
        },
        5,
    )


class HostCopies(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts what travels from the GPU to the host, in values, while it is active."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.sizes: list[int] = []

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Run an operation, and note the size of its result if that came from the GPU."""
        result = function(*args, **(kwargs or {}))
        given = [value for value in args if isinstance(value, torch.Tensor)]
        was_on_gpu = any(tensor.is_cuda for tensor in given)
        if was_on_gpu and isinstance(result, torch.Tensor) and not result.is_cuda:
            self.sizes.append(result.numel())
        if was_on_gpu and function is torch.ops.aten._local_scalar_dense.default:
            self.sizes.append(1)
        return result


def copied(call: Callable[[], object]) -> str:
    """How many values a call copies to the host, and the largest copy."""
    with HostCopies() as copies:
        call()
    return f"{len(copies.sizes)} copies, the largest of {max(copies.sizes, default=0):,}"


def kernels(options: argparse.Namespace) -> Iterator[str]:
    """numba's kernels compile and run on this GPU, so that holes are filled there"""
    if not torch.cuda.is_available():
        raise Skip("PyTorch sees no NVIDIA GPU on this machine")
    device = device_for_kernels(torch.device("cuda", 0))
    if device.type != "cuda":
        raise SystemExit("holes would be filled on the processor: see the warning")
    yield "they do"


def aims(options: argparse.Namespace) -> Iterator[str]:
    """each figure beside its aim: the paper's completion at most 10 % of SHARP's time, a completed
    view 60 ms, a scene of four views 600 ms, a training step 20 ms
    """
    gpu = renderer()
    scene, camera = holed_scene()
    placed = FillContext(scene, camera, gpu, shipped_network()).on_renderer_device
    guard = placed.photo_guard()
    view = find_view(scene, camera, gpu, TENTH_HOLES)[1]
    before = gpu.render(placed.base, view)
    depths = DepthRange.of(scene, is_metric=True)
    four = [
        *leftmost_and_rightmost(camera, 0.3, depths),
        *leftmost_and_rightmost(camera, 0.2, depths),
    ]
    sixty = trajectory_cameras("rotate-forward", camera, 0.2, depths, 60)
    filled = Gaussians.cat([placed.base, fill_view(placed, view, [guard], before).aux])

    calls: dict[str, tuple[str, Callable[[], object]]] = {
        "paper's completion of a view, HAR 10 %": (
            "10 % of SHARP",
            lambda: placed.complete_as_paper(view, before),
        ),
        "default completion of a view": ("60 ms", lambda: fill_view(placed, view, [guard], before)),
        "a scene filled for four views": ("600 ms with SHARP", lambda: fill_scene(placed, four)),
        "60 frames of a scene": ("1 s", lambda: [gpu.render(filled, eye) for eye in sixty]),
    }
    if options.checkpoint is not None:
        base, photo = sharp(options, "bf16")
        calls["SHARP, bf16"] = ("", lambda: base.predict(photo))
    tasks: dict[str, TimedTask] = {
        f"{name} (aim: {aim}; {copied(call)})" if aim else f"{name} ({copied(call)})": (
            lambda _, call=call: call()  # type: ignore[misc]
        )
        for name, (aim, call) in calls.items()
    }
    yield from rows(tasks, 5)


def suite(options: argparse.Namespace) -> Iterator[str]:
    """completion adds at most 3 ms to a view, and 60 frames are rendered within a second"""
    renderer()
    with tempfile.TemporaryDirectory() as folder:
        weights = [] if options.checkpoint is None else ["-c", str(options.checkpoint)]
        asked = [
            "--device",
            "cuda",
            "--only",
            "limits,completion,photo,video" + (",sharp" if weights else ""),
        ]
        list(
            run(
                sys.executable,
                str(REPOSITORY / "benchmarks" / "suite.py"),
                *asked,
                *weights,
                "-o",
                folder,
            )
        )
        yield from (Path(folder) / "suite.md").read_text(encoding="utf-8").splitlines()[2:]


# The first ones say what is not known yet, if the time on the GPU should end.
STEPS = (
    machine,
    build,
    kernels,
    aims,
    empty,
    parity,
    against_cpu,
    sanitizer,
    waits,
    precisions,
    training,
    speed,
    completion,
    suite,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the steps; returns 0 unless one failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("gpu.md"))
    parser.add_argument("-c", "--checkpoint", type=Path)
    parser.add_argument("--only", default=",".join(step.__name__ for step in STEPS))
    parser.add_argument("--step", help=argparse.SUPPRESS)
    words = sys.argv[1:] if arguments is None else list(arguments)
    options = parser.parse_args(words)
    steps = {step.__name__: step for step in STEPS}
    if options.step:
        try:
            for line in steps[options.step](options):
                print(line, flush=True)
        except Skip as reason:
            print(f"skipped: {reason}")
            return SKIPPED
        return 0
    chosen = options.only.split(",")
    if unknown := set(chosen) - set(steps):
        parser.error(f"--only {', '.join(sorted(unknown))}: the steps are {', '.join(steps)}")
    if options.checkpoint is not None:
        check_file(options.checkpoint, "file of SHARP's weights")
    check_writable(options.output)
    facts = {
        **hardware_facts(CUDA if torch.cuda.is_available() else torch.device("cpu")),
        **package_versions(),
    }
    lines = [
        "## A GPU",
        "",
        f"{', '.join(f'{key} {value}' for key, value in facts.items())}; commit {commit()}.",
    ]
    failed = 0
    for name in chosen:
        start, command = time.perf_counter(), [sys.executable, __file__, *words, "--step", name]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
            code, said, log = done.returncode, done.stdout.strip(), done.stderr
        except subprocess.TimeoutExpired:
            code, said, log = 1, "", f"not done after {LIMIT_S} s"
        seconds = time.perf_counter() - start
        state = {0: "done", SKIPPED: "skipped"}.get(code, f"FAILED (exit status {code})")
        print(f"{name}: {state}, {seconds:.0f} s", file=sys.stderr)
        failed += code not in (0, SKIPPED)
        lines += [
            "",
            f"**{name}** must show: {steps[name].__doc__}. {state}, {seconds:.0f} s.",
            "",
            said,
        ]
        if code not in (0, SKIPPED):
            lines += ["", "```", log[-2000:].strip(), "```"]
        write_atomic(options.output, ("\n".join(lines).strip() + "\n").encode())
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(run_script(main))
