"""Numbers of the impulse ledger in six axes that are no gains.

Sizes of wrenches are |W| = sqrt(W . M^-1 W) [N/sqrt(kg)], and of twists |V| = sqrt(V . M V).
"""

ONSET_SIGMAS = 4.0  # standard deviations of the noise's size; a larger reading is a contact
LEAST_RATE = 0.03  # 1/s; as is one larger than this times the size of the twist, also without noise
LONGEST_MEAN = 2000.0  # readings; longest time scale of the mean of the bias
LONGEST_FLIGHT = 0.05  # s; longest time scale of the means of lag and twist in free flight
RECENT = 0.08  # s; a touch so soon after the last one keeps its delay and speed: the hardware still settles
LEAST_SHARE = 0.02  # least share of the twist along the contact's direction that determines the delay
LEAST_SPEED = 0.2  # least approach speed of a contact, over the size of the twist
LEAST_TWIST = 1e-9  # m sqrt(kg)/s; avoids a division by zero
TURNED = 0.8  # cosine of the angle by which the direction turns before the tangent model begins anew
FEATURES = 4  # number of parameters of the tangent model
BEND = 0.03  # s; depth over speed at which the quadratic column equals the linear one
MISFIT = 0.02  # standard deviation of the tangent model's error, over the force
LEAST_ERROR = 0.05  # 1/s; least standard deviation of a reading over the speed
MOST_GROWTH = 1.5  # forgetting stops where the variances have grown to so much of the prior's (sum of 3)
MOST_DAMPING = 0.5  # largest damping, over the control rate
BRIDGE_STEPS = 12  # steps of the bridge from the last reading to the present
AHEAD = 0.5  # control periods; the bridge ends in the middle of the command's period
HIGHEST = 2.0  # upper bound of the bridged force, over the peak force expected or read
LEAST_STIFFNESS = 100.0  # 1/s^2; stiffness for the limit of the correction, at least
