"""Build a triaxial ellipsoid, smooth or with relief, for a body without a shape model."""

from __future__ import annotations

import numpy as np

from .noise import fractal_noise
from .shape import Float64, Int32

# Wavelengths of the relief in mean radii. The shortest is four edges of the mesh; below its facets, a patch
# continues the roughness that it measures on the mesh.
_WAVELENGTHS = np.array([1.2, 0.6, 0.3, 0.15, 0.075])
# Exponent of the amplitude with the wavelength; assumed, within the 0.3 to 1 of natural surfaces (`roughness`).
_HURST = 0.9
_SEED = 20_260
_GRADIENT_NOISE_STD = 0.22  # `noise.gradient_noise`


def ellipsoid(semi_axes_m: tuple[float, float, float], relief_m: float = 0.0) -> tuple[Float64, Int32]:
    """Return a triaxial ellipsoid as a closed mesh of 82,000 triangles: vertices float64[n, 3], m; faces int32.

    Parameters
    ----------
    semi_axes_m
        Semi-axes along x, y and z.
    relief_m
        Root mean square height of random relief, normal to the ellipsoid. It is the same for the same axes. With 0,
        the ellipsoid is smooth.
    """
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=6)
    axes = np.array(semi_axes_m)
    points, faces = np.asarray(sphere.vertices) * axes, np.asarray(sphere.faces, dtype=np.int32)
    if not relief_m:
        return points, faces
    wavelengths = _WAVELENGTHS * float(np.prod(axes)) ** (1 / 3)
    amplitudes = _WAVELENGTHS**_HURST
    amplitudes *= relief_m / (_GRADIENT_NOISE_STD * float(np.linalg.norm(amplitudes)))
    normals = points / axes**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    height = fractal_noise(points + wavelengths[0] / 3, _SEED, wavelengths, amplitudes)
    return points + height[:, None] * normals, faces
