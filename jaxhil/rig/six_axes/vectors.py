"""Six-axis linear algebra: wrenches, poses and twists are lists of six floats (x, y, z, rx, ry, rz).

All vectors are in the axes of target frame T (notebooks/guide/six_axes.md, section 1). Sums are added in the
order of their terms. C is the frame of the chaser's docking interface.
"""

from math import factorial, isfinite, sqrt
from typing import Annotated

AXES = 6
COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
LAG_LEADS = ("lag_lead_x", "lag_lead_y", "lag_lead_z", "lag_lead_rx", "lag_lead_ry", "lag_lead_rz")
# (1 - t/2 cot(t/2))/t^2 as a power series of t^2: |B_2k|/(2k)! with Bernoulli's numbers B
COTANGENT = (
    1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600,
    3617 / 10670622842880000, 43867 / 5109094217170944000, 174611 / 802857662698291200000,
)  # fmt: skip
LAST_TERM = len(COTANGENT) - 1
# sin t/t and (1 - cos t)/t^2 as power series of t^2
SINE = tuple((-1) ** k / factorial(2 * k + 1) for k in range(15))
COSINE = tuple((-1) ** k / factorial(2 * k + 2) for k in range(15))
LAST_SINE_TERM = len(SINE) - 1
MAX_SQUARED_ANGLE = 10.0  # largest argument of the series [rad^2]; rotation vectors end at pi^2

Triple = Annotated[list[float], 3]
Vector = Annotated[list[float], AXES]
Matrix = Annotated[list[list[float]], AXES, AXES]


def product(matrix: Matrix, vector: Vector) -> Vector:
    """Return matrix times vector."""
    x, y, z, rx, ry, rz = vector
    return [row[0] * x + row[1] * y + row[2] * z + row[3] * rx + row[4] * ry + row[5] * rz for row in matrix]


def dot(left: Vector, right: Vector) -> float:
    """Return the scalar product."""
    return (
        left[0] * right[0]
        + left[1] * right[1]
        + left[2] * right[2]
        + left[3] * right[3]
        + left[4] * right[4]
        + left[5] * right[5]
    )


def subtract(left: Vector, right: Vector) -> Vector:
    """Return the difference left - right."""
    return [a - b for a, b in zip(left, right, strict=True)]


def add_multiple(left: Vector, factor: float, right: Vector) -> Vector:
    """Return left + factor * right."""
    return [a + factor * b for a, b in zip(left, right, strict=True)]


def multiply(factor: float, vector: Vector) -> Vector:
    """Return factor * vector."""
    return [factor * entry for entry in vector]


def wrench_at_chaser(wrench: Vector, pose: Vector) -> Vector:
    """Move the reference point of a wrench from T's to C's origin; `pose` is the pose of C relative to T."""
    fx, fy, fz, mx, my, mz = wrench
    x, y, z = pose[:3]
    return [fx, fy, fz, mx - (y * fz - z * fy), my - (z * fx - x * fz), mz - (x * fy - y * fx)]


def wrench_at_target(wrench: Vector, pose: Vector) -> Vector:
    """Move the reference point of a wrench from C's to T's origin; `pose` is the pose of C relative to T."""
    fx, fy, fz, mx, my, mz = wrench
    x, y, z = pose[:3]
    return [fx, fy, fz, mx + (y * fz - z * fy), my + (z * fx - x * fz), mz + (x * fy - y * fx)]


def cross(left: Triple, right: Triple) -> Triple:
    """Return the vector product."""
    a, b, c = left
    x, y, z = right
    return [b * z - c * y, c * x - a * z, a * y - b * x]


def rotate(pose: Vector, vector: Triple) -> Triple:
    """Convert a vector from C axes to T axes; `pose` is the pose of C relative to T.

    The result is R v = v + sin t/t theta x v + (1 - cos t)/t^2 theta x (theta x v), where R is the rotation
    matrix, theta the rotation vector of the pose, and t = |theta|.
    """
    _, _, _, a, b, c = pose
    square = a * a + b * b + c * c
    if not square < MAX_SQUARED_ANGLE:
        square = MAX_SQUARED_ANGLE
    sine, cosine = SINE[LAST_SINE_TERM], COSINE[LAST_SINE_TERM]
    for index in range(LAST_SINE_TERM - 1, -1, -1):
        sine = SINE[index] + square * sine
        cosine = COSINE[index] + square * cosine
    axis = pose[3:]
    once = cross(axis, vector)
    x, y, z = cross(axis, once)
    return [
        vector[0] + sine * once[0] + cosine * x,
        vector[1] + sine * once[1] + cosine * y,
        vector[2] + sine * once[2] + cosine * z,
    ]


def coordinate_rates(pose: Vector, twist: Vector) -> Vector:
    """Return the time derivatives of a pose's coordinates (p, theta) at the twist (v, w).

    theta' = Jl(theta)^-1 w = w - theta x w/2 + c theta x (theta x w), where Jl is the left Jacobian,
    c = (1 - t/2 cot(t/2))/t^2 and t = |theta|.
    """
    _, _, _, a, b, c = pose
    x, y, z, u, v, w = twist
    square = a * a + b * b + c * c
    if not square < MAX_SQUARED_ANGLE:
        square = MAX_SQUARED_ANGLE
    weight = COTANGENT[LAST_TERM]
    for index in range(LAST_TERM - 1, -1, -1):
        weight = COTANGENT[index] + square * weight
    first, second, third = b * w - c * v, c * u - a * w, a * v - b * u
    return [
        x,
        y,
        z,
        u - 0.5 * first + weight * (b * third - c * second),
        v - 0.5 * second + weight * (c * first - a * third),
        w - 0.5 * third + weight * (a * second - b * first),
    ]


def lead_pose(leads: Vector, pose: Vector, rates: Vector) -> Vector:
    """Add to each coordinate of a pose its rate times its lead time [s]."""
    return [at + lead * rate for at, lead, rate in zip(pose, leads, rates, strict=True)]


def is_finite(vector: Vector) -> bool:
    """Return whether all entries are finite."""
    a, b, c, x, y, z = vector
    is_linear_finite = isfinite(a) and isfinite(b) and isfinite(c)
    return is_linear_finite and isfinite(x) and isfinite(y) and isfinite(z)


def is_within(vector: Vector, lowest: Vector, highest: Vector) -> bool:
    """Return whether all entries are within their bounds; False if an entry is NaN."""
    inside = True
    for low, value, high in zip(lowest, vector, highest, strict=True):
        inside = inside and low <= value <= high
    return inside


def length(pose: Vector, other: Vector) -> float:
    """Return the distance [m] between the positions of two poses."""
    x, y, z = pose[0] - other[0], pose[1] - other[1], pose[2] - other[2]
    return sqrt(x * x + y * y + z * z)


def angle(pose: Vector, other: Vector) -> float:
    """Return the distance [rad] between the rotation vectors of two poses."""
    x, y, z = pose[3] - other[3], pose[4] - other[4], pose[5] - other[5]
    return sqrt(x * x + y * y + z * z)
