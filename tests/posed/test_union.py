"""The union of photos: each surface once, and nothing that a photo sees through."""

from __future__ import annotations

import dataclasses
import functools

import torch
from helpers.posed_captures import BOX_Z, EYES, LEFT_OUT_EYE, WALL_Z, camera_at, view
from helpers.scenes import psnr

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.posed.exposure import gains_of_photos, with_gain
from spackle.posed.union import PlacedPhoto, Union, merge_photos
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio

RENDERER = CpuRenderer()


@functools.cache
def placed(index: int, depth_factor: float = 1.0) -> PlacedPhoto:
    """A photo of box and wall, in the world in which both were made."""
    eye = EYES[index]
    camera = camera_at(eye).to(dtype=torch.float32)
    scene = view(eye)
    at_origin = dataclasses.replace(
        scene, camera=dataclasses.replace(camera, world_to_camera=torch.eye(4))
    )
    own = at_origin.lift().gaussians.scaled(depth_factor)
    in_world = own.transform(torch.linalg.inv(camera.world_to_camera.double()))
    return PlacedPhoto.of(in_world, camera, error=0.005, renderer=RENDERER)


@functools.cache
def merged() -> Union:
    return merge_photos([placed(1), placed(0), placed(2)], RENDERER)


def left_out_camera() -> Camera:
    return camera_at(LEFT_OUT_EYE).to(dtype=torch.float32)


def layers_of_wall(gaussians: Gaussians) -> float:
    """How often, on average, the wall beside the box is covered by Gaussians' areas."""
    x, y, z = gaussians.means.unbind(1)
    in_piece = (x > 0.9) & (x < 1.5) & (y.abs() < 0.6) & ((z - WALL_Z).abs() < 0.5)
    wide = gaussians.scales[in_piece].sort(dim=1, descending=True).values
    # Areas in units of those of one photo's Gaussians: see the test.
    return float((wide[:, 0] * wide[:, 1]).sum())


def test_a_wall_that_photos_share_appears_once() -> None:
    one_photo = layers_of_wall(placed(1).gaussians)
    all_photos = layers_of_wall(
        Gaussians.cat([placed(index).gaussians for index in range(len(EYES))])
    )
    union = layers_of_wall(merged().gaussians)
    assert all_photos > 2.2 * one_photo
    assert union < 1.25 * one_photo


def test_the_union_shows_the_place_of_a_photo_that_was_left_out() -> None:
    rendering = RENDERER.render(merged().gaussians, left_out_camera())
    truth = view(LEFT_OUT_EYE).rgb
    covered = rendering.alpha > 0.95
    assert float(covered.float().mean()) > 0.93
    assert psnr(rendering.rgb[covered], truth[covered]) > 22


def test_merging_opens_no_holes_in_a_photo() -> None:
    for index in range(len(EYES)):
        photo = placed(index)
        before = hole_area_ratio(photo.alpha)
        after = hole_area_ratio(RENDERER.render(merged().gaussians, photo.camera).alpha)
        assert after <= before + 0.005


def test_a_floater_that_another_photo_sees_through_is_gone() -> None:
    photo = placed(1)
    spot = photo.gaussians.select(slice(0, 12))
    camera_places = torch.tensor([[0.7, -0.6 + 0.1 * k, 2.0] for k in range(12)])
    floaters = dataclasses.replace(spot, means=camera_places.float())
    with_floaters = PlacedPhoto.of(
        Gaussians.cat([photo.gaussians, floaters]), photo.camera, photo.error, RENDERER
    )
    union = merge_photos([with_floaters, placed(0), placed(2)], RENDERER)
    z = union.gaussians.means[:, 2]
    x = union.gaussians.means[:, 0]
    in_the_air = (x > 0.6) & (z < 0.5 * (BOX_Z + WALL_Z))
    assert int(in_the_air.sum()) == 0
    assert union.contradicted >= 12


def test_the_order_of_ranks_decides_between_equally_good_photos() -> None:
    union = merged()
    # The first photo is whole but for what another one sees much better; the others add the rest.
    assert union.counts[0] > 0.9 * len(placed(1).gaussians)
    assert union.counts[1] < 0.6 * len(placed(0).gaussians)
    assert sum(union.counts) == len(union.gaussians)


def test_a_single_photo_stays_as_it_is() -> None:
    union = merge_photos([placed(1)], RENDERER)
    assert torch.equal(union.gaussians.means, placed(1).gaussians.means)
    assert (union.doubled, union.contradicted) == (0, 0)


def dimmed(photo: PlacedPhoto, factor: torch.Tensor) -> PlacedPhoto:
    """The photo as if it had been exposed for less light of each colour."""
    colors = photo.gaussians.colors * factor
    gaussians = dataclasses.replace(photo.gaussians, colors=colors)
    return PlacedPhoto.of(gaussians, photo.camera, photo.error, RENDERER)


def test_exposure_and_white_balance_become_those_of_the_first_photo() -> None:
    factor = torch.tensor([0.7, 0.6, 0.8])
    photos = [placed(2), dimmed(placed(0), factor)]
    gains = gains_of_photos(photos)
    assert torch.equal(gains[0], torch.ones(3).double())
    assert torch.allclose(gains[1], 1 / factor.double(), rtol=0.04)
    evened = [with_gain(photo, gain) for photo, gain in zip(photos, gains, strict=True)]
    # The left part of the left photo's own view is seen by no other photo.
    truth = view(EYES[0]).rgb
    fidelity = []
    for versions in (photos, evened):
        rendering = RENDERER.render(merge_photos(versions, RENDERER).gaussians, placed(0).camera)
        covered = rendering.alpha > 0.95
        fidelity.append(psnr(rendering.rgb[covered], truth[covered]))
    assert fidelity[1] > fidelity[0] + 2


def test_photos_of_equal_exposure_keep_their_colours() -> None:
    photos = [placed(1), placed(0), placed(2)]
    gains = gains_of_photos(photos)
    assert torch.equal(gains, torch.ones(3, 3).double())
    assert with_gain(photos[1], gains[1]) is photos[1]
