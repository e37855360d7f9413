"""Height of the ground: gentle enough to drive on, never flat, so that mistakes in z show."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_TWO_PI = 2 * np.pi


@dataclass(frozen=True)
class Ground:
    """A plane with two sine waves."""

    height_m: float
    slope: tuple[float, float]
    waves: tuple[tuple[float, float, float, float], ...]
    """Amplitude in meters, wave numbers along x and y in rad/m, phase."""

    def height_at(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Height in meters at points of the plane."""
        x, y = points[..., 0], points[..., 1]
        height = self.height_m + self.slope[0] * x + self.slope[1] * y
        for amplitude, wave_x, wave_y, phase in self.waves:
            height = height + amplitude * np.sin(wave_x * x + wave_y * y + phase)
        return height


def draw_ground(rng: np.random.Generator, base_m: float = 24.0) -> Ground:
    """Ground that rises and falls by 1-2 m over 150 m and stays within about 5 m of `base_m` in the whole network.

    Args:
        rng: Generator of the slope and the waves.
        base_m: Height at (0, 0) without waves, m.
    """
    waves = []
    for _ in range(2):
        # a wave of this length, running in this direction
        length, angle = rng.uniform(150, 400), rng.uniform(0, _TWO_PI)
        number = _TWO_PI / length
        amplitude, wave_x, wave_y = rng.uniform(0.3, 0.8), number * np.cos(angle), number * np.sin(angle)
        waves.append((float(amplitude), float(wave_x), float(wave_y), float(rng.uniform(0, _TWO_PI))))
    angle, steepness = rng.uniform(0, _TWO_PI), rng.uniform(0, 0.006)
    return Ground(base_m, (float(steepness * np.cos(angle)), float(steepness * np.sin(angle))), tuple(waves))
