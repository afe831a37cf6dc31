"""Sine, cosine, the angle of a vector and hyperbolic tangent from operations that all processors round alike.

This gives a step the same bits on every machine; the functions of libraries and compilers round differently.
Sine and cosine use the polynomials of Cephes (S. Moshier, netlib.org/cephes, sinf.c); their error is at most 1e-7 up
to 8192 rad and 1e-6 up to 1e5 rad. The angle uses those of atanf.c; its error is at most 4 units in the last place, and
the hyperbolic tangent's is at most 7.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

QUARTER = 1.57079632679489661923  # pi / 2
# pi / 2 in three parts, the first two exact in float32 with room for a 13-bit multiple (Cody and Waite)
QUARTER_PARTS = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
REST_BOUND = 0.8  # rad; slightly beyond pi / 4, since `quarters` is rounded from an already rounded product
SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)


def _polynomial(x: Array, coefficients: tuple[float, ...]) -> Array:
    total = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        total = total * x + c
    return total


def cos_sin(angle: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return cosine and sine of an angle, rad. Beyond 1e9 rad a float32 has no digits left; any point may result."""
    quarters = jnp.round(angle * (1 / QUARTER))
    rest = angle
    for part in QUARTER_PARTS:
        rest = rest - quarters * part
    rest = jnp.where(rest != rest, rest, jnp.clip(rest, -REST_BOUND, REST_BOUND))
    square = rest * rest
    sine = rest + rest * square * _polynomial(square, SINE)
    cosine = 1.0 - 0.5 * square + square * square * _polynomial(square, COSINE)
    quadrant = quarters - 4.0 * jnp.floor(quarters * 0.25)  # 0, 1, 2 or 3
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    cos, sin = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    cos = jnp.where((quadrant == 1.0) | (quadrant == 2.0), -cos, cos)
    return cos, jnp.where(quadrant >= 2.0, -sin, sin)


EIGHTH_TANGENT = 0.41421356237309503  # tan(pi / 8)
ARCTANGENT = (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)


def angle_of(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the angle of the vector (x, y), rad, from -pi to pi; 0 for the zero vector."""
    across, up = jnp.abs(x), jnp.abs(y)
    longer, shorter = jnp.maximum(across, up), jnp.minimum(across, up)
    slope = shorter / jnp.where(longer == 0.0, 1.0, longer)  # 0 to 1
    steep = slope > EIGHTH_TANGENT
    rest = jnp.where(steep, (slope - 1.0) / (slope + 1.0), slope)  # tan(a - pi / 4) beyond pi / 8
    square = rest * rest
    angle = rest + rest * square * _polynomial(square, ARCTANGENT) + jnp.where(steep, QUARTER / 2, 0.0)
    angle = jnp.where(up > across, QUARTER - angle, angle)
    angle = jnp.where(x < 0.0, 2 * QUARTER - angle, angle)
    return jnp.where(y < 0.0, -angle, angle)


TANH_BOUND = 7.90531110763549805  # beyond it, tanh is +-1 in float32
TANH_TINY = 0.0004  # below it, tanh(x) is x in float32
# Rational approximation of Eigen (MathFunctionsImpl.h, ptanh_float), highest power first
TANH_ODD = (
    -2.76076847742355e-16,
    2.00018790482477e-13,
    -8.60467152213735e-11,
    5.12229709037114e-08,
    1.48572235717979e-05,
    6.37261928875436e-04,
    4.89352455891786e-03,
)
TANH_EVEN = (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)


def tanh(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the hyperbolic tangent."""
    inside = jnp.clip(x, -TANH_BOUND, TANH_BOUND)
    square = inside * inside
    value = inside * _polynomial(square, TANH_ODD) / _polynomial(square, TANH_EVEN)
    return jnp.where(jnp.abs(x) < TANH_TINY, x, value)
