"""Elastic material constants."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Material:
    """Isotropic material: Young's modulus [Pa], Poisson's ratio [-], density [kg/m^3]."""

    youngs_modulus: float
    poisson_ratio: float
    density: float

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's constants (lambda, mu) [Pa]."""
        e, nu = self.youngs_modulus, self.poisson_ratio
        return e * nu / ((1 + nu) * (1 - 2 * nu)), e / (2 * (1 + nu))
