"""Area and moment of inertia of polygons and circles, per unit of density.

Follows Jax2D 1.0.1 (`jax2d.engine`: calc_inverse_mass_polygon, calc_inverse_inertia_polygon and their circle
counterparts), including its three deviations from the textbook, because masses are part of its results: the
centroid is the mean of the vertices (exact for triangles and parallelograms), a triangle's inertia counts the
unused fourth vertex instead of the face back to the first, and a circle has m r^2 / 4, half the inertia of a disc.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from levelproof.physics.types import MAX_VERTICES
from levelproof.physics.vector import nonzero, vec

Vertices = Float[Array, "polygon vertex 2 lane"]  # the fourth of a triangle is unused


def polygon_area(vertices: Vertices, n_vertices: Int[Array, "polygon lane"]) -> Float[Array, "polygon lane"]:
    """Return the area, m^2, as a fan of triangles around the first vertex."""
    area = jnp.zeros(n_vertices.shape)
    for k in range(1, MAX_VERTICES - 1):
        a, b = (vec(vertices[:, i] - vertices[:, 0]) for i in (k, k + 1))
        area += jnp.where(k < n_vertices - 1, jnp.abs(a.cross(b)) / 2, 0.0)
    return area


def polygon_inertia(vertices: Vertices, n_vertices: Int[Array, "polygon lane"]) -> Float[Array, "polygon lane"]:
    """Return the inertia per density, m^4, about the origin, which must be the centroid.

    Sums triangles (origin, p, q) over the faces p-q; one contributes area / 6 * (p.p + p.q + q.q).
    """
    inertia = jnp.zeros(n_vertices.shape)
    for k in range(MAX_VERTICES):
        p, q = vec(vertices[:, k]), vec(vertices[:, (k + 1) % MAX_VERTICES])
        triangle = jnp.abs(p.cross(q)) * (p.dot(p) + p.dot(q) + q.dot(q)) / 12
        inertia += jnp.where(k < n_vertices, triangle, 0.0)
    return inertia


def circle_area(radius: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the area, m^2."""
    return math.pi * radius * radius


def circle_inertia(radius: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the inertia per density, m^4, about the centre."""
    return math.pi * radius**4 / 4


def inverse(mass: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return 1 / mass, or 1 for a mass of 0: unused rows have no extent and must not divide by 0."""
    return 1 / nonzero(mass)
