"""Weighted recursive identification of contact stiffness and damping from F = k p + b p'."""


class ContactIdentification:
    """Weighted recursive least squares with forgetting, in Bierman's factored form.

    With regressor phi = (p, p') and a reading's weight w, the recursion is K = w P phi/(lambda_w + w
    phi' P phi), theta += K (F - phi' theta), P = (P - K phi' P)/lambda_w, lambda_w = 1 - w (1 -
    lambda): the textbook's where w = 1, nothing where w = 0. Here P = U D U' with U = [[1, u], [0,
    1]] and D = diag(d1, d2), which stays symmetric and positive whatever the rounding (Bierman,
    "Factorization Methods for Discrete Sequential Estimation", 1977). d1 and d2 never exceed their
    initial values: held still, a contact tells nothing new of one of the two, whose variance
    forgetting alone would let wind up.

    Initial stiffness in N/m and damping in N s/m, initial covariance 1/m^2 and s^2/m^2 (relative
    to the force's variance), forgetting in (0, 1].
    """

    __slots__ = (
        "_d1", "_d2", "_forgetting", "_initial_covariance", "_initial_parameters", "_u", "damping",
        "stiffness",
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
        """Forget parameters and covariance."""
        self.stiffness, self.damping = self._initial_parameters
        self.restart_covariance()

    def restart_covariance(self) -> None:
        """Keep the parameters, with their initial uncertainty."""
        self._u = 0.0
        self._d1, self._d2 = self._initial_covariance

    @property
    def covariance(self) -> tuple[float, float, float]:
        """(P_kk, P_kb, P_bb) of P = U D U'."""
        u, d1, d2 = self._u, self._d1, self._d2
        return d1 + u * d2 * u, u * d2, d2

    def update(self, force: float, deflection: float, rate: float, weight: float) -> None:
        """Take in one reading: force [N], signed deflection [m], its rate [m/s] and its weight."""
        u = self._u
        d1 = self._d1
        d2 = self._d2
        stiffness = self.stiffness
        damping = self.damping
        kept = 1.0 - weight * (1.0 - self._forgetting)

        f2 = u * deflection + rate
        g1 = weight * d1 * deflection
        g2 = weight * d2 * f2
        a1 = kept + deflection * g1
        a2 = a1 + f2 * g2
        innovation = force - (stiffness * deflection + damping * rate)

        self.stiffness = stiffness + (g1 + g2 * u) / a2 * innovation
        self.damping = damping + g2 / a2 * innovation
        self._u = u - g1 * f2 / a1
        d1 /= a1
        d2 *= a1 / (a2 * kept)
        most1, most2 = self._initial_covariance
        self._d1 = d1 if d1 < most1 else most1
        self._d2 = d2 if d2 < most2 else most2
