"""Constants of the impulse ledger in six axes.

M is the relative mass matrix. The norm of a wrench is |W| = sqrt(W . M^-1 W) [N/sqrt(kg)], the norm of a
twist is |V| = sqrt(V . M V) [m sqrt(kg)/s].
"""

ONSET_SIGMAS = 4.0  # standard deviations of the noise; minimum norm of a reading that counts as contact
MIN_RATE = 0.03  # minimum of |W|/|V| for a reading that counts as contact [1/s]
MAX_MEAN = 2000.0  # limit on the memory of the bias, which is a mean of readings [readings]
MAX_FLIGHT = 0.05  # limit on the memory of the means of lag and twist in free flight [s]
RECENT = 0.08  # time after a contact [s] within which the next contact takes its delay and speed
MIN_SHARE = 0.02  # minimum speed along the contact's direction for computing D, divided by |V| [1]
MIN_SPEED = 0.2  # minimum approach speed of a contact, divided by |V| [1]
MIN_TWIST = 1e-9  # m sqrt(kg)/s; avoids a division by zero
TURNED = 0.8  # minimum cosine of a turn of the contact's direction [1]; below it, the tangent model restarts
FEATURES = 4  # number of parameters of the tangent model
BEND = 0.03  # depth divided by speed at which the quadratic regressor equals the linear regressor [s]
MISFIT = 0.02  # standard deviation of the tangent model's error, divided by the force [1]
MIN_ERROR = 0.05  # minimum standard deviation of a force reading per unit mass and approach speed [1/s]
MAX_GROWTH = 1.5  # forgetting stops above this sum of 3 variances, each divided by its prior [1]
MAX_DAMPING = 0.5  # limit on the damping times the control period [1]
BRIDGE_STEPS = 12  # number of integration steps from the last reading to the present
AHEAD = 0.5  # end of the prediction [control periods]: the middle of the command's period
HIGHEST = 2.0  # limit on the predicted force, divided by the larger of expected and measured peak [1]
# limit on the force per unit mass in the prediction [m/s^2]: without it, a wrong estimate overflows to NaN
MAX_PUSH = 1e6
MIN_STIFFNESS = 100.0  # lower bound of the stiffness in the limit of the correction [1/s^2]
INITIAL_CONTACT_AGE = 1e9  # time since the last contact [ticks] at the beginning of a run
MIN_CONTACT_READINGS = 5.0  # minimum number of readings in the tangent model; below it the status is `unsure`
LATE = 0.8  # limit on D divided by the contact's duration [1]; beyond it the status is `too_short`
SAMPLES = 512  # length of the rig's delay line [ticks], a power of two
MAX_RECALL = SAMPLES - 2.0  # maximum delay, because interpolation needs one older sample [ticks]
