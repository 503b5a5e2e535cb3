"""Rays against the triangles of a world, by Intel's Embree; the only file that imports it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from spackle.runtime.kernels import kernel
from worlds.meshes import Material, Mesh
from worlds.pictures import BYTE_TO_LINEAR, Pyramids, fetch, find_pictures, pyramids, srgb_to_linear

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
MISS = -1
GLASS_OPACITY = 0.6  # a material below it is looked through
GLASS_PASS = 0.88  # share of light that a pane lets through
MAX_LAYERS = 10  # of leaves or panes that a ray passes
NUDGE_M = 3e-4  # how far from a surface a ray continues
FAR_M = 1e9


@dataclasses.dataclass(frozen=True)
class Hits:
    """Where rays meet the first surface that is not seen through."""

    triangle: Ints  # [N] index in the world's mesh, −1 for none
    distance: Floats  # [N] in units of the ray's direction, inf for none
    u: Floats  # [N] barycentric weight of the second corner
    v: Floats  # [N] and of the third
    transmittance: Floats  # [N] share of light that panes before the surface let through; 1: none

    def select(self, indices: NDArray[np.int64]) -> Hits:
        """Those with these indices [M]."""
        return Hits(
            self.triangle[indices],
            self.distance[indices],
            self.u[indices],
            self.v[indices],
            self.transmittance[indices],
        )


class World:
    """The triangles of a world, ready to be hit and shaded."""

    def __init__(self, mesh: Mesh, pictures: dict[str, NDArray[np.uint8]]) -> None:
        """Build the search trees.

        Args:
            mesh: all triangles.
            pictures: textures that are no files, by the name that materials give.
        """
        self.mesh = mesh
        materials = mesh.materials
        names = sorted({one.texture for one in materials if one.texture is not None})
        self.pyramids: Pyramids = pyramids(find_pictures(names, pictures))

        # Arrays with an entry for each of the M materials, which compiled code can read.
        numbers = {name: number for number, name in enumerate(names)}
        self.texture = np.array(
            [MISS if one.texture is None else numbers[one.texture] for one in materials], np.int32
        )  # [M] number of the picture, MISS without one
        base = srgb_to_linear(np.array([_paint(one) for one in materials]))
        tints = np.array([one.tint for one in materials], np.float32)
        self.color = (base * tints).astype(np.float32)  # [M, 3] linear, multiplies the texture
        self.specular = np.array([one.specular for one in materials], np.float32)
        self.roughness = np.array([one.roughness for one in materials], np.float32)
        self.emission = np.array([one.emission for one in materials], np.float32)
        self.is_glass = np.array([one.opacity < GLASS_OPACITY for one in materials], bool)
        holed = np.array(
            [number >= 0 and bool(self.pyramids.has_holes[number]) for number in self.texture],
            bool,
        )
        self.is_sheer = self.is_glass | holed

        # Rays may pass glass and the holes of leaves. These triangles have a tree of their own, so
        # that all others, which are most, need no look at their texture.
        sheer = self.is_sheer[mesh.material]
        self.solid = _Tree(mesh.corners, np.flatnonzero(~sheer).astype(np.int32))
        self.sheer = _Tree(mesh.corners, np.flatnonzero(sheer).astype(np.int32))
        self.texel_density = _texel_density(mesh, self.texture, self.pyramids)

    def first_hits(self, origins: Floats, directions: Floats) -> Hits:
        """Where rays [N, 3] meet the first surface; panes and holes in leaves are passed."""
        hits = self.solid.hits(origins, directions)
        if not self.sheer.count:
            return hits

        # Sheer surfaces in front of the solid one are looked at one after the other, until one
        # stops the ray.
        start = np.zeros(len(origins), np.float32)  # [N] the distance from which a ray goes on
        going = np.arange(len(origins))  # indices of the rays that go on
        for _ in range(MAX_LAYERS):
            begin = origins[going] + start[going, None] * directions[going]
            layer = self.sheer.hits(begin, directions[going])
            distance = layer.distance + start[going]
            nearer = (layer.triangle >= 0) & (distance < hits.distance[going])
            going = going[nearer]
            if not len(going):
                break
            triangle = layer.triangle[nearer]
            u = layer.u[nearer]
            v = layer.v[nearer]

            # A leaf stops the ray where its picture is more than half opaque; a pane never does.
            coverage = self._coverage(triangle, u, v)
            glass = self.is_glass[self.mesh.material[triangle]]
            stops = (coverage >= 0.5) & ~glass
            here = going[stops]
            hits.triangle[here] = triangle[stops]
            hits.distance[here] = distance[nearer][stops]
            hits.u[here] = u[stops]
            hits.v[here] = v[stops]
            hits.transmittance[going[glass]] *= GLASS_PASS

            # The other rays go on a little behind the surface.
            start[going] = distance[nearer] + NUDGE_M
            going = going[~stops]
            if not len(going):
                break
        return hits

    def blocked(self, origins: Floats, directions: Floats, distances: Floats) -> NDArray[np.bool_]:
        """[N] whether something lies on rays [N, 3] nearer than `distances` [N]; panes do not."""
        result = self.solid.blocked(origins, directions, distances)
        if not self.sheer.count:
            return result

        # As in `first_hits`: rays go on through sheer surfaces, until one stops them.
        going = np.flatnonzero(~result)
        start = np.zeros(len(origins), np.float32)
        for _ in range(MAX_LAYERS):
            if not len(going):
                break
            begin = origins[going] + start[going, None] * directions[going]
            layer = self.sheer.hits(begin, directions[going])
            distance = layer.distance + start[going]
            nearer = (layer.triangle >= 0) & (distance < distances[going])
            going = going[nearer]
            triangle = layer.triangle[nearer]
            coverage = self._coverage(triangle, layer.u[nearer], layer.v[nearer])
            stops = (coverage >= 0.5) & ~self.is_glass[self.mesh.material[triangle]]
            result[going[stops]] = True
            start[going] = distance[nearer] + NUDGE_M
            going = going[~stops]
        return result

    def normals(self, hits: Hits, directions: Floats) -> tuple[Floats, Floats]:
        """Smooth and flat unit normals [N, 3] at hits, towards the ray's origin; 0 for none."""
        smooth = np.zeros_like(directions)
        flat = np.zeros_like(directions)
        _normals(
            self.mesh.corners,
            self.mesh.normals,
            hits.triangle,
            hits.u,
            hits.v,
            directions,
            smooth,
            flat,
        )
        return smooth, flat

    def albedo(self, hits: Hits, footprint_m: Floats) -> Floats:
        """[N, 3] linear colours of the surfaces at hits, filtered over `footprint_m` [N] metres."""
        return self._texels(hits.triangle, hits.u, hits.v, footprint_m)[:, :3]

    def _coverage(self, triangle: Ints, u: Floats, v: Floats) -> Floats:
        """[N] coverage of the material at points of triangles; 1 without a texture."""
        footprint_m = np.zeros(len(triangle), np.float32)
        return self._texels(triangle, u, v, footprint_m)[:, 3]

    def _texels(self, triangle: Ints, u: Floats, v: Floats, footprint_m: Floats) -> Floats:
        """[N, 4] linear colour and coverage of the material at points of triangles.

        `footprint_m` [N] is how wide an area each colour is the mean of, in metres.
        """
        texels = np.zeros((len(triangle), 4), np.float32)
        _albedo(
            triangle,
            u,
            v,
            footprint_m,
            self.mesh.uv,
            self.mesh.material,
            self.texture,
            self.color,
            self.texel_density,
            self.pyramids.texels,
            self.pyramids.offsets,
            self.pyramids.sizes,
            self.pyramids.levels,
            BYTE_TO_LINEAR,
            texels,
        )
        return texels


def _paint(material: Material) -> tuple[float, float, float]:
    """SRGB by which a material's texture is multiplied; its colour if it has no texture.

    Exporters leave any grey as the colour of textured surfaces, so only its hue counts, and only by
    half.
    """
    if material.texture is None:
        return material.color
    brightest = max(material.color)
    if brightest < 0.02:  # black has no hue
        return 1.0, 1.0, 1.0
    red, green, blue = (0.5 + 0.5 * value / brightest for value in material.color)
    return red, green, blue


class _Tree:
    """Embree's search tree over some of a world's triangles."""

    def __init__(self, corners: Floats, triangles: Ints) -> None:
        """Build the tree over `triangles`, indices in `corners` [F, 3, 3]."""
        self.triangles = triangles
        self.count = len(triangles)
        self.scene: Any = None
        if self.count:
            self.scene = rtcore_scene.EmbreeScene()
            # The scene does not keep the mesh alive.
            self.geometry = TriangleMesh(self.scene, np.ascontiguousarray(corners[triangles]))

    def hits(self, origins: Floats, directions: Floats) -> Hits:
        """The nearest triangles on rays [N, 3]."""
        count = len(origins)
        triangle = np.full(count, MISS, np.int32)
        distance = np.full(count, np.inf, np.float32)
        ones = np.ones(count, np.float32)
        if self.scene is None or not count:
            zero = np.zeros(count, np.float32)
            return Hits(triangle, distance, zero, zero.copy(), ones)
        found = self.scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            output=1,
        )
        met = found["primID"] >= 0
        triangle[met] = self.triangles[found["primID"][met]]
        distance[met] = found["tfar"][met]
        return Hits(triangle, distance, found["u"].copy(), found["v"].copy(), ones)

    def blocked(self, origins: Floats, directions: Floats, distances: Floats) -> NDArray[np.bool_]:
        """[N] whether a triangle lies on rays [N, 3] nearer than `distances` [N]."""
        if self.scene is None or not len(origins):
            return np.zeros(len(origins), bool)
        found = self.scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            dists=np.ascontiguousarray(distances, np.float32),
            query="OCCLUDED",
        )
        return np.asarray(found >= 0)


def _texel_density(mesh: Mesh, texture: Ints, pictures: Pyramids) -> Floats:
    """[F] texels per metre on each triangle; 0 without a texture."""
    number = texture[mesh.material]  # [F] of the picture
    sides = mesh.corners[:, 1:] - mesh.corners[:, :1]  # [F, 2, 3] metres
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)

    # The same triangle in the picture. Both areas are twice the triangle's, which cancels out.
    size = pictures.sizes[np.maximum(number, 0)]
    flat = (mesh.uv[:, 1:] - mesh.uv[:, :1]) * size[:, None]  # [F, 2, 2] texels
    flat_area = np.abs(flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0])
    density = np.sqrt(flat_area / np.maximum(area, 1e-12))
    return np.where(number >= 0, density, 0.0).astype(np.float32)


@kernel
def _normals(
    corners: Any,
    normals: Any,
    triangle: Any,
    u: Any,
    v: Any,
    directions: Any,
    smooth: Any,
    flat: Any,
) -> None:
    """Write the interpolated and the flat unit normals of hits, both towards the ray's origin.

    Args:
        corners, normals: [F, 3, 3] of all triangles.
        triangle: [N] where the rays hit; negative for none.
        u, v: [N] barycentric weights of the second and third corner.
        directions: [N, 3] of the rays.
        smooth, flat: [N, 3] outputs; left as they are for rays that hit nothing.
    """
    for n in range(triangle.shape[0]):
        t = triangle[n]
        if t < 0:
            continue

        # The flat normal (x, y, z) is the cross product of two sides.
        a = corners[t, 1] - corners[t, 0]
        b = corners[t, 2] - corners[t, 0]
        x = a[1] * b[2] - a[2] * b[1]
        y = a[2] * b[0] - a[0] * b[2]
        z = a[0] * b[1] - a[1] * b[0]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-20)
        x /= length
        y /= length
        z /= length
        if x * directions[n, 0] + y * directions[n, 1] + z * directions[n, 2] > 0:
            x = -x
            y = -y
            z = -z
        flat[n, 0] = x
        flat[n, 1] = y
        flat[n, 2] = z

        # The smooth normal (p, q, r) is the mean of those at the corners.
        w = 1.0 - u[n] - v[n]
        p = w * normals[t, 0, 0] + u[n] * normals[t, 1, 0] + v[n] * normals[t, 2, 0]
        q = w * normals[t, 0, 1] + u[n] * normals[t, 1, 1] + v[n] * normals[t, 2, 1]
        r = w * normals[t, 0, 2] + u[n] * normals[t, 1, 2] + v[n] * normals[t, 2, 2]
        side = p * x + q * y + r * z
        length = np.sqrt(p * p + q * q + r * r)
        # Corners may run either way round; a normal in the face's plane says nothing.
        if length < 1e-6 or abs(side) < 0.1 * length:
            p = x
            q = y
            r = z
        else:
            sign = 1.0 / length if side > 0 else -1.0 / length
            p *= sign
            q *= sign
            r *= sign
        smooth[n, 0] = p
        smooth[n, 1] = q
        smooth[n, 2] = r


@kernel
def _albedo(
    triangle: Any,
    u: Any,
    v: Any,
    footprint_m: Any,
    uv: Any,
    material: Any,
    texture: Any,
    color: Any,
    density: Any,
    texels: Any,
    offsets: Any,
    sizes: Any,
    levels: Any,
    to_linear: Any,
    out: Any,
) -> None:
    """Write linear colour and coverage of hits to `out` [N, 4].

    Args:
        triangle: [N] where the rays hit; negative for none, whose output is left as it is.
        u, v: [N] barycentric weights of the second and third corner.
        footprint_m: [N] width in metres of the area that a colour is the mean of.
        uv: [F, 3, 2] texture coordinates of all triangles.
        material: [F] of all triangles.
        texture: [M] the number of a material's picture; negative for none.
        color: [M, 3] linear colour of a material, which multiplies its picture.
        density: [F] texels per metre.
        texels, offsets, sizes, levels: all pictures, see `Pyramids`.
        to_linear: [256] linear values of bytes.
        out: [N, 4] red, green, blue and coverage.
    """
    sample = np.zeros(4, np.float32)
    for n in range(triangle.shape[0]):
        t = triangle[n]
        if t < 0:
            continue
        m = material[t]
        number = texture[m]
        out[n, 0] = color[m, 0]
        out[n, 1] = color[m, 1]
        out[n, 2] = color[m, 2]
        out[n, 3] = 1.0
        if number < 0:
            continue
        w = 1.0 - u[n] - v[n]
        s = w * uv[t, 0, 0] + u[n] * uv[t, 1, 0] + v[n] * uv[t, 2, 0]
        r = w * uv[t, 0, 1] + u[n] * uv[t, 1, 1] + v[n] * uv[t, 2, 1]
        fetch(
            texels,
            offsets[number],
            sizes[number],
            levels[number],
            to_linear,
            s,
            r,
            footprint_m[n] * density[t],
            sample,
        )
        out[n, 0] *= sample[0]
        out[n, 1] *= sample[1]
        out[n, 2] *= sample[2]
        out[n, 3] = sample[3]
