"""Area and moment of inertia of polygons and circles, per unit of density.

As Jax2D 1.0.1 computes them (`jax2d.engine`: calc_inverse_mass_polygon, calc_inverse_inertia_polygon and their
likes for circles). It deviates from the textbook in three places, kept because masses are part of its results: the
centroid is the mean of the vertices (exact for triangles and parallelograms), a triangle's inertia counts the
unused fourth vertex instead of the face back to the first, and a circle has m r^2 / 4, half of a disc's.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from levelproof.physics.types import MAX_VERTICES
from levelproof.physics.vector import nonzero, vec

Vertices = Float[Array, "polygon vertex 2 lane"]  # the fourth of a triangle is unused


def polygon_area(vertices: Vertices, n_vertices: Int[Array, "polygon lane"]) -> Float[Array, "polygon lane"]:
    """m^2, of the fan of triangles around the first vertex."""
    area = jnp.zeros(n_vertices.shape)
    for k in range(1, MAX_VERTICES - 1):
        a, b = (vec(vertices[:, i] - vertices[:, 0]) for i in (k, k + 1))
        area += jnp.where(k < n_vertices - 1, jnp.abs(a.cross(b)) / 2, 0.0)
    return area


def polygon_inertia(vertices: Vertices, n_vertices: Int[Array, "polygon lane"]) -> Float[Array, "polygon lane"]:
    """m^4, about the origin, which must be the centroid: the triangles from it to each face p-q."""
    inertia = jnp.zeros(n_vertices.shape)
    for k in range(MAX_VERTICES):
        p, q = vec(vertices[:, k]), vec(vertices[:, (k + 1) % MAX_VERTICES])
        triangle = jnp.abs(p.cross(q)) * (p.dot(p) + p.dot(q) + q.dot(q)) / 12
        inertia += jnp.where(k < n_vertices, triangle, 0.0)
    return inertia


def circle_area(radius: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """m^2."""
    return math.pi * radius * radius


def circle_inertia(radius: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """m^4, about the centre."""
    return math.pi * radius**4 / 4


def inverse(mass: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1 / mass, and 1 for a mass of 0: what has no extent must not divide by it."""
    return 1 / nonzero(mass)
