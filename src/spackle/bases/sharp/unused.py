"""What SHARP's checkpoint holds and inference never reads: it is checked by name and shape, then dropped."""

from __future__ import annotations

from spackle.bases.sharp.config import SharpConfig

Shapes = dict[str, tuple[int, ...]]

_STEPS = 4  # halvings of the U-Net
_WIDTH = 16  # its channels at full size


def unused_shapes(config: SharpConfig) -> Shapes:
    """Names and shapes of the transformers' classifiers and of the branch that aligns depth in training."""
    shapes: Shapes = {}
    for encoder in ("patch_encoder", "image_encoder"):
        name = f"monodepth_model.monodepth_predictor.encoder.{encoder}.head"
        shapes |= {f"{name}.weight": (config.classes, config.embed), f"{name}.bias": (config.classes,)}
    return shapes | {f"depth_alignment.scale_map_estimator.{name}": shape for name, shape in _unet().items()}


def _unet() -> Shapes:
    """A U-Net that maps two depths to a scale: a level is two residual blocks."""
    widths = [_WIDTH << level for level in range(_STEPS + 1)]
    shapes = _conv("encoder.conv_in.0", 2, _WIDTH, 3) | _norm("encoder.conv_in.1", _WIDTH)
    for level in range(_STEPS):
        shapes |= _level(f"encoder.convs_down.{level}", widths[level], widths[level + 1])
    for level in range(_STEPS):
        wide, narrow = widths[_STEPS - level], widths[_STEPS - level - 1]
        shapes |= _level(f"decoder.convs_up.{level}", 2 * wide if level else wide, narrow)
    shapes |= _norm("decoder.conv_out.0", 2 * _WIDTH) | _conv("decoder.conv_out.2", 2 * _WIDTH, _WIDTH, 1)
    return shapes | _norm("decoder.conv_out.3", _WIDTH) | _conv("conv_out", _WIDTH, 1, 1)


def _level(name: str, dim_in: int, dim_out: int) -> Shapes:
    """Two residual blocks behind a change of size, which has no parameters."""
    return (
        _block(f"{name}.1", dim_in, dim_out)
        | _conv(f"{name}.1.shortcut", dim_in, dim_out, 1)
        | _block(f"{name}.2", dim_out, dim_out)
    )


def _block(name: str, dim_in: int, dim_out: int) -> Shapes:
    hidden = dim_out // 2
    return (
        _norm(f"{name}.residual.0", dim_in)
        | _conv(f"{name}.residual.2", dim_in, hidden, 3)
        | _norm(f"{name}.residual.3", hidden)
        | _conv(f"{name}.residual.5", hidden, dim_out, 3)
    )


def _conv(name: str, dim_in: int, dim_out: int, size: int) -> Shapes:
    return {f"{name}.weight": (dim_out, dim_in, size, size), f"{name}.bias": (dim_out,)}


def _norm(name: str, dim: int) -> Shapes:
    return {f"{name}.weight": (dim,), f"{name}.bias": (dim,)}
