"""Values that programs hold keep every number and their mask on the way in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from spackle.core.array_values import plain_array, without_unit_axes
from spackle.core.photo import photo_from_picture
from spackle.runtime.errors import InputError

EXACT = np.array([[0.5, 1, 2], [4, 8, 0.125]], np.float32)  # exact in floats of 8 bits, too


class Foreign:
    """An array of another package, which NumPy converts."""

    def __init__(self, numbers: NDArray[Any]) -> None:
        self.numbers = numbers

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.numbers, dtype)


class OnTheGpu:
    """An array that may not be copied from the GPU without saying so, as CuPy's."""

    def __init__(self, numbers: NDArray[Any]) -> None:
        self.numbers = numbers

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        raise TypeError("implicit conversion to a NumPy array is not allowed")

    def __dlpack__(self, **options: Any) -> Any:
        return self.numbers.__dlpack__()

    def __dlpack_device__(self) -> Any:
        return self.numbers.__dlpack_device__()


@pytest.mark.parametrize(
    "value",
    [
        EXACT,
        EXACT.astype(">f4"),
        EXACT.astype("<f2"),
        EXACT.astype(">f8"),
        EXACT.astype(np.longdouble),
        np.asfortranarray(EXACT),
        EXACT[::-1, ::-1].copy()[::-1, ::-1],  # a view with negative strides
        EXACT.tolist(),
        torch.from_numpy(EXACT),
        torch.from_numpy(EXACT).bfloat16(),
        torch.from_numpy(EXACT).half(),
        torch.from_numpy(EXACT).to(torch.float8_e5m2),
        torch.from_numpy(EXACT).double().requires_grad_(),
        torch.from_numpy(EXACT).T.contiguous().T,
        torch.from_numpy(EXACT).to_sparse(),
        Image.fromarray(EXACT),
        Foreign(EXACT),
        Foreign(EXACT.astype(">f4")),
        OnTheGpu(EXACT),
        np.ma.masked_array(EXACT),
    ],
    ids=lambda value: str(getattr(value, "dtype", type(value).__name__)),
)
def test_every_number_arrives(value: Any) -> None:
    plain = plain_array(value, "value")
    np.testing.assert_array_equal(plain.numbers, EXACT)
    assert plain.numbers.dtype.isnative
    assert plain.known is None or bool(plain.known.all())
    torch.from_numpy(plain.numbers.copy())  # which takes only types that PyTorch has


@pytest.mark.parametrize("dtype", [">u2", "<u2", "u1", ">i4", "<i8", "<u8"])
def test_integers_stay_integers(dtype: str) -> None:
    numbers = np.array([[0, 1, 255]], dtype)
    plain = plain_array(numbers, "value")
    assert plain.numbers.dtype == np.dtype(dtype).newbyteorder("=")
    np.testing.assert_array_equal(plain.numbers, numbers)


def test_a_mask_says_what_is_unknown() -> None:
    masked = np.ma.masked_greater(EXACT, 3)
    known = plain_array(masked, "value").known
    assert known is not None
    np.testing.assert_array_equal(known, EXACT <= 3)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((5, 7), (5, 7)),
        ((1, 5, 7), (5, 7)),
        ((5, 7, 1), (5, 7)),
        ((1, 1, 5, 7), (5, 7)),
        ((1, 5, 7, 1), (5, 7)),
        ((1, 1, 7), (1, 7)),
        ((1, 7), (1, 7)),
        ((2, 5, 7), (2, 5, 7)),
        ((1, 2, 5, 7), (2, 5, 7)),
    ],
)
def test_axes_of_length_1_are_left_out(shape: Any, expected: Any) -> None:
    assert without_unit_axes(np.zeros(shape), 2).shape == expected


@pytest.mark.parametrize(
    "value",
    [
        np.zeros((2, 3), complex),
        np.zeros((2, 3), bool),
        np.array([["a", None]], object),
        np.zeros(3, "f4,f4"),
        [[1.0, 2.0], [3.0]],
        torch.zeros(2, 3, dtype=torch.bool),
        torch.zeros(2, 3, dtype=torch.complex64),
        torch.zeros(2, 3, device="meta"),
    ],
    ids=lambda value: str(getattr(value, "dtype", type(value).__name__)),
)
def test_values_without_numbers_are_refused(value: Any) -> None:
    with pytest.raises(InputError, match=r"^value: "):
        plain_array(value, "value")


BYTES = np.random.default_rng(0).integers(0, 256, (40, 48, 3), np.uint8)
RGB = BYTES / np.float32(255)


@pytest.mark.parametrize(
    ("picture", "tolerance"),
    [
        (Image.fromarray(BYTES), 0),
        (BYTES, 0),
        (BYTES.astype(np.uint16) * 257, 0),  # 257 · 255 is 65535
        ((BYTES.astype(np.uint16) * 257).astype(">u2"), 0),
        (RGB, 0),
        (RGB.astype(">f8"), 0),
        (RGB.astype(np.float16), 1e-3),
        (torch.from_numpy(RGB).bfloat16(), 4e-3),
        (torch.from_numpy(BYTES), 0),
        (torch.from_numpy(BYTES).permute(2, 0, 1), 0),
        (torch.from_numpy(BYTES).permute(2, 0, 1)[None], 0),
        (BYTES[None], 0),
        (Foreign(BYTES), 0),
        (np.concatenate([RGB, np.ones_like(RGB[..., :1])], axis=-1), 0),
    ],
)
def test_a_photo_is_the_same_in_every_form(picture: Any, tolerance: float) -> None:
    rgb = photo_from_picture(picture).rgb
    assert (rgb.dtype, rgb.shape) == (torch.float32, (40, 48, 3))
    np.testing.assert_allclose(rgb.numpy(), RGB, rtol=0, atol=tolerance + 1e-7)


def test_grey_transparent_and_masked_photos() -> None:
    grey = BYTES[..., 0]
    for form in (grey, grey[..., None], grey[None], Image.fromarray(grey)):
        rgb = photo_from_picture(form).rgb.numpy()
        np.testing.assert_array_equal(rgb, np.repeat(RGB[..., :1], 3, axis=-1))

    # Pillow composes transparent pictures over white, too.
    opacity = np.arange(40 * 48, dtype=np.int64).reshape(40, 48, 1) % 256
    rgba = np.concatenate([BYTES, opacity.astype(np.uint8)], axis=-1)
    composed = photo_from_picture(rgba).rgb
    torch.testing.assert_close(
        composed, photo_from_picture(Image.fromarray(rgba)).rgb, rtol=0, atol=0.5 / 255 + 1e-6
    )

    masked = np.ma.masked_array(BYTES, np.repeat(BYTES[..., :1] > 99, 3, axis=-1))
    rgb = photo_from_picture(masked).rgb.numpy()
    is_hidden = BYTES[..., 0] > 99
    assert (rgb[is_hidden] == 1).all()
    np.testing.assert_array_equal(rgb[~is_hidden], RGB[~is_hidden])


def test_bfloat16_of_another_package() -> None:
    # JAX's arrays become NumPy arrays of a type that this package adds.
    ml_dtypes = pytest.importorskip("ml_dtypes")
    plain = plain_array(Foreign(EXACT.astype(ml_dtypes.bfloat16)), "value")
    np.testing.assert_array_equal(plain.numbers, EXACT)
