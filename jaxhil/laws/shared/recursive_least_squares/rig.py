"""Weighted recursive least squares for contact stiffness k and damping b in F = k p + b p', p the depth."""


class ContactIdentification:
    """Weighted recursive least squares for stiffness k and damping b in F = k p + b p', p the depth.

    For theta = (k, b), its covariance P, phi = (p, p') and a reading's weight w, the recursion is
    K = w P phi/(lambda_w + w phi^T P phi), theta += K (F - phi^T theta), P = (P - K phi^T P)/lambda_w, with
    lambda_w = 1 - w (1 - lambda). The factors of P = U D U^T, U = [[1, u], [0, 1]], D = diag(d1, d2), keep P
    symmetric and positive despite rounding (Bierman, "Factorization Methods for Discrete Sequential
    Estimation", 1977). d1 and d2 never exceed their initial values: a contact at rest has no information on
    the damping, and forgetting would increase the variance of the damping without limit.

    Args:
        stiffness: initial stiffness [N/m].
        damping: initial damping [N s/m].
        stiffness_covariance: initial d1 [1/m^2], relative to the force's variance.
        damping_covariance: initial d2 [s^2/m^2], relative to the force's variance.
        forgetting: lambda, in (0, 1].
    """

    __slots__ = (
        "_forgetting", "_initial_covariance", "_initial_parameters", "coupling", "damping",
        "damping_variance", "stiffness", "stiffness_variance",
    )  # fmt: skip

    def __init__(
        self,
        stiffness: float,
        damping: float,
        stiffness_covariance: float,
        damping_covariance: float,
        forgetting: float,
    ) -> None:
        self._initial_parameters = (stiffness, damping)
        self._initial_covariance = (stiffness_covariance, damping_covariance)
        self._forgetting = forgetting
        self.reset()

    def reset(self) -> None:
        """Return to the initial parameters and covariance."""
        self.stiffness, self.damping = self._initial_parameters
        self.restart_covariance()

    def restart_covariance(self) -> None:
        """Return to the initial covariance; keep the parameters."""
        self.coupling = 0.0  # u
        self.stiffness_variance, self.damping_variance = self._initial_covariance  # d1, d2

    def update(self, force: float, deflection: float, rate: float, weight: float) -> None:
        """Update the estimate with force [N], signed penetration [m], its rate [m/s] and weight (0 to 1)."""
        u = self.coupling
        d1 = self.stiffness_variance
        d2 = self.damping_variance
        stiffness = self.stiffness
        damping = self.damping
        factor = 1.0 - weight * (1.0 - self._forgetting)

        f2 = u * deflection + rate
        g1 = weight * d1 * deflection
        g2 = weight * d2 * f2
        a1 = factor + deflection * g1
        a2 = a1 + f2 * g2
        innovation = force - (stiffness * deflection + damping * rate)

        self.stiffness = stiffness + (g1 + g2 * u) / a2 * innovation
        self.damping = damping + g2 / a2 * innovation
        self.coupling = u - g1 * f2 / a1
        d1 /= a1
        d2 *= a1 / (a2 * factor)
        most1, most2 = self._initial_covariance
        self.stiffness_variance = d1 if d1 < most1 else most1
        self.damping_variance = d2 if d2 < most2 else most2
