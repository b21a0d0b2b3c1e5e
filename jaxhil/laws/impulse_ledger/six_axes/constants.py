"""Constants of the impulse ledger in six axes.

The norm of a wrench is |W| = sqrt(W . M^-1 W) [N/sqrt(kg)], the norm of a twist is |V| = sqrt(V . M V)
[m sqrt(kg)/s].
"""

ONSET_SIGMAS = 4.0  # standard deviations of the noise; a reading with a larger norm is a contact
LEAST_RATE = 0.03  # 1/s; a contact's |W| also exceeds this rate times |V|
LONGEST_MEAN = 2000.0  # readings; limits the memory of the mean that is the bias
LONGEST_FLIGHT = 0.05  # s; limits the memory of the means of lag and twist in free flight
RECENT = 0.08  # s; a contact so soon after the last keeps its delay and speed: the hardware has not settled
LEAST_SHARE = 0.02  # [1]; least share of |V| along the contact's direction from which to compute the delay
LEAST_SPEED = 0.2  # [1]; least approach speed of a contact, divided by |V|
LEAST_TWIST = 1e-9  # m sqrt(kg)/s; avoids a division by zero
TURNED = 0.8  # [1]; if the direction turns so that the cosine is smaller, the tangent model restarts
FEATURES = 4  # number of parameters of the tangent model
BEND = 0.03  # s; depth divided by speed at which the quadratic regressor equals the linear regressor
MISFIT = 0.02  # [1]; standard deviation of the tangent model's error, divided by the force
LEAST_ERROR = 0.05  # 1/s; least standard deviation of a force reading, divided by the approach speed
MOST_GROWTH = 1.5  # [1]; forgetting stops if the sum of 3 variances, each divided by its prior, exceeds this
MOST_DAMPING = 0.5  # [1]; largest damping times the control period
BRIDGE_STEPS = 12  # number of integration steps from the last reading to the present
AHEAD = 0.5  # control periods; the prediction ends in the middle of the command's period
HIGHEST = 2.0  # [1]; largest predicted force, divided by the expected or measured peak force
LEAST_STIFFNESS = 100.0  # 1/s^2; lower bound of the stiffness in the limit of the correction
