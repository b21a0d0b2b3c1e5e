/* The controller that the rig calls once per control period.
 *
 * It checks what comes in and what goes out, watches the clock, and leaves the law to its own file. Whatever
 * is not finite trips it: from then on the force is 0 until `reset`. No memory is allocated: the caller owns
 * the controller's struct.
 */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "law.c"

/* == Declarations == */

typedef enum {
    JAXHIL_OK,
    JAXHIL_UNUSABLE_GAINS,
    JAXHIL_FORCE_NOT_FINITE,
    JAXHIL_POSITION_NOT_FINITE,
    JAXHIL_CLOCK,
    JAXHIL_COMMAND_NOT_FINITE,
    JAXHIL_MODEL_NOT_FINITE
} jaxhil_status;

typedef struct {
    jaxhil_law law;
    double period, late;
    double time, command;
    bool timed;
    jaxhil_status status;
    int64_t missed_ticks;
} jaxhil_controller;

/* Begin with these gains. False if they are not admitted: the controller then stays tripped. */
bool jaxhil_init(jaxhil_controller *controller, const jaxhil_gains *gains);

/* The force [N] that the numerical model is to feel this tick, from force [N], positions [m] and velocity
 * [m/s]; `time` [s] may be NULL. Once tripped, 0.0 until reset. */
double jaxhil_step(jaxhil_controller *controller, double force_measured, double position_desired,
                   double velocity_desired, double position_measured, const double *time);

/* The position [m] to command, from the numerical model's motion after this tick's step. */
double jaxhil_position_command(jaxhil_controller *controller, double position, double velocity,
                               double acceleration);

/* Restart everything: filters, identified parameters, a trip, the count of ticks. */
void jaxhil_reset(jaxhil_controller *controller);

/* Begin a fresh run for the next contact; identified parameters carry over, a trip stays latched. */
void jaxhil_next_contact(jaxhil_controller *controller);

/* Identified stiffness [N/m] and damping [N s/m]; 0 and 0 if the law identifies none. */
void jaxhil_identified(const jaxhil_controller *controller, double *stiffness, double *damping);

/* == Definitions == */

static double jaxhil_trip(jaxhil_controller *controller, jaxhil_status status) {
    controller->status = status;
    return 0.0;
}

bool jaxhil_init(jaxhil_controller *controller, const jaxhil_gains *gains) {
    controller->period = gains->control_period;
    controller->late = 1.5 * gains->control_period;
    const bool usable = jaxhil_law_init(&controller->law, gains);
    controller->status = JAXHIL_OK;
    controller->timed = false;
    controller->time = 0.0;
    controller->command = 0.0;
    controller->missed_ticks = 0;
    if (!usable) {
        jaxhil_trip(controller, JAXHIL_UNUSABLE_GAINS);
    }
    return usable;
}

double jaxhil_step(jaxhil_controller *controller, double force_measured, double position_desired,
                   double velocity_desired, double position_measured, const double *time) {
    if (controller->status != JAXHIL_OK) {
        return 0.0;
    }
    if (!isfinite(force_measured)) {
        return jaxhil_trip(controller, JAXHIL_FORCE_NOT_FINITE);
    }
    if (!isfinite(position_desired) || !isfinite(velocity_desired)) {
        return jaxhil_trip(controller, JAXHIL_MODEL_NOT_FINITE);
    }
    if (!isfinite(position_measured)) {
        return jaxhil_trip(controller, JAXHIL_POSITION_NOT_FINITE);
    }
    if (time != NULL) {
        const double now = *time;
        if (!isfinite(now)) {
            return jaxhil_trip(controller, JAXHIL_CLOCK);
        }
        if (controller->timed && now - controller->time > controller->late) {
            const double missed = (now - controller->time) / controller->period + 0.5;
            if (!(missed < 9007199254740992.0)) {
                return jaxhil_trip(controller, JAXHIL_CLOCK);
            }
            controller->missed_ticks += (int64_t)missed - 1;
        }
        controller->time = now;
        controller->timed = true;
    }
    const double command = jaxhil_law_step(&controller->law, force_measured, position_desired,
                                           velocity_desired, position_measured);
    return isfinite(command) ? command : jaxhil_trip(controller, JAXHIL_COMMAND_NOT_FINITE);
}

double jaxhil_position_command(jaxhil_controller *controller, double position, double velocity,
                               double acceleration) {
    if (controller->status == JAXHIL_UNUSABLE_GAINS) {
        return controller->command;
    }
    const double command = jaxhil_law_position_command(&controller->law, position, velocity, acceleration);
    if (isfinite(command) && isfinite(velocity) && isfinite(acceleration)) {
        controller->command = command;
    } else if (controller->status == JAXHIL_OK) {
        jaxhil_trip(controller, JAXHIL_MODEL_NOT_FINITE);
    }
    return controller->command;
}

void jaxhil_reset(jaxhil_controller *controller) {
    if (controller->status == JAXHIL_UNUSABLE_GAINS) {
        return;
    }
    jaxhil_law_reset(&controller->law);
    controller->status = JAXHIL_OK;
    controller->timed = false;
    controller->command = 0.0;
    controller->missed_ticks = 0;
}

void jaxhil_next_contact(jaxhil_controller *controller) {
    if (controller->status == JAXHIL_UNUSABLE_GAINS) {
        return;
    }
    jaxhil_law_next_contact(&controller->law);
    controller->timed = false;
}

void jaxhil_identified(const jaxhil_controller *controller, double *stiffness, double *damping) {
    jaxhil_law_identified(&controller->law, stiffness, damping);
}
