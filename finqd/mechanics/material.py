"""Elastic material constants."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Material:
    """Isotropic material: Young's modulus [Pa], Poisson's ratio [-], density [kg/m^3], and Rayleigh damping.

    rayleigh_mass: force against the velocity, as a rate at which momentum decays [1/s]
    rayleigh_stiffness: stress against the rate of strain, as a time in which a strain relaxes [s]
    Both brake as `finqd.mechanics.damping` says.
    """

    youngs_modulus: float
    poisson_ratio: float
    density: float
    rayleigh_mass: float = 0.0
    rayleigh_stiffness: float = 0.0

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's constants (lambda, mu) [Pa]."""
        e, nu = self.youngs_modulus, self.poisson_ratio
        return e * nu / ((1 + nu) * (1 - 2 * nu)), e / (2 * (1 + nu))
