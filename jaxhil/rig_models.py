"""Choice of the rig model for a mechanism with one axis or six axes."""

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.evaluation import RigModel
from jaxhil.simulation.one_axis import ONE_AXIS


def choose_rig_model(mechanism: AnyMechanism) -> RigModel:
    """Return the rig model (simulation of rig and contact) for a mechanism with one axis or six axes.

    The six-axis code is imported only for a six-axis mechanism.

    Example:
        >>> import jaxhil
        >>> from jaxhil.rig_models import choose_rig_model
        >>> choose_rig_model(jaxhil.load("rig-300kg")).axes
        1
    """
    if not isinstance(mechanism, SixAxisMechanism):
        return ONE_AXIS
    from jaxhil.sixdof.six_axes import SIX_AXES

    return SIX_AXES
