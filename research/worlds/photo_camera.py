"""A camera that turns light into a photo: exposure, tone, colour, glare, blur, noise, JPEG."""

from __future__ import annotations

import dataclasses
import io

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from worlds.pictures import linear_to_srgb

Rng = np.random.Generator
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class Development:
    """How light becomes a photo; the same for all views of a world."""

    exposure: float
    white_balance: Floats  # [3]
    contrast: float  # 0: soft, 1: as film
    saturation: float
    glare: float  # share of light that spreads over the picture around bright places
    vignette: float  # loss of light in the corners
    blur_px: float  # of lens and demosaicing
    noise: float  # deviation of noise of a middle grey
    jpeg: int  # quality


def choose_development(rng: Rng, radiance: Floats, balanced: tuple[float, float]) -> Development:
    """Settings of a camera that meters a view [H, W, 3], and is not always right.

    `balanced` is the range of the share of a cast that white balance takes away. In the open it is
    lower, because green there is grass and not a lamp's light.
    """
    brightness = radiance @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    middle = float(np.median(brightness))
    mean = float(np.minimum(brightness, 6 * middle + 1e-4).mean())
    exposure = 0.21 / max(mean, 1e-4) * 2 ** float(rng.normal(0.1, 0.35))

    # Cameras balance most of a light's colour away.
    capped = np.minimum(radiance, 4 * max(mean, 1e-4))
    grey = capped.reshape(-1, 3).mean(0)
    cast = grey / max(float(grey.mean()), 1e-6)
    balance = cast ** -float(rng.uniform(*balanced)) * np.exp(rng.normal(0, 0.03, 3))
    return Development(
        exposure=exposure,
        white_balance=balance.astype(np.float32),
        contrast=float(rng.uniform(0.1, 0.7)),
        saturation=float(rng.uniform(0.85, 1.2)),
        glare=float(rng.uniform(0.01, 0.06)),
        vignette=float(rng.uniform(0.0, 0.25)),
        blur_px=float(rng.choice([0.0, rng.uniform(0.3, 0.6)], p=[0.4, 0.6])),
        noise=float(abs(rng.normal(0, 0.008))),
        jpeg=int(rng.integers(70, 97)),
    )


def developed(radiance: Floats, settings: Development) -> Floats:
    """[H, W, 3] sRGB in 0..1 of linear light, without noise and blur."""
    light = np.minimum(radiance * settings.exposure * settings.white_balance, 40.0)
    height, width = light.shape[:2]
    spread = sum(
        cv2.GaussianBlur(np.minimum(light, 10.0), (0, 0), width * size) for size in (0.01, 0.05)
    )
    light = light * (1 - settings.glare) + settings.glare * np.asarray(spread) / 2
    y, x = np.mgrid[:height, :width]
    away = np.hypot((x + 0.5) / width - 0.5, (y + 0.5) / height - 0.5) / 0.7071
    light = light * (1 - settings.vignette * away**2)[..., None]

    # Highlights roll off; film adds contrast.
    soft = light * (1 + light / 16) / (1 + light * 0.75)
    film = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)  # Narkowicz 2015
    toned = soft + (film * 0.9 - soft) * settings.contrast
    grey = (toned @ np.array([0.2126, 0.7152, 0.0722]))[..., None]
    toned = grey + (toned - grey) * settings.saturation
    return linear_to_srgb(toned)


def photographed(rng: Rng, srgb: Floats, settings: Development) -> bytes:
    """The photo as a JPEG file, with blur and noise."""
    picture = srgb
    if settings.blur_px:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), settings.blur_px), np.float32)
    # Noise of light grows with its root; half of it is shared by neighbours, as demosaicing does.
    grain = rng.standard_normal(picture.shape).astype(np.float32)
    coarse = cv2.GaussianBlur(rng.standard_normal(picture.shape).astype(np.float32), (0, 0), 0.8)
    strength = settings.noise * (1.4 - 0.8 * picture)
    picture = np.clip(picture + strength * (0.6 * grain + coarse), 0, 1)
    stream = io.BytesIO()
    Image.fromarray((picture * 255 + 0.5).astype(np.uint8)).save(
        stream, "JPEG", quality=settings.jpeg
    )
    return stream.getvalue()
