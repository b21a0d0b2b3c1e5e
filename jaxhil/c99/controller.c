/* The controller that the rig calls once per control period.
 *
 * It checks what comes in, watches every contact's energy, leaves the law to the compensator that its gain
 * file names, and limits what goes out. A trip is latched until reset: the force is led to 0, the position
 * command to rest out of contact. The faults are listed above. Every function takes bounded time.
 */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "clock.c"
#include "faults_table.c"
#include "inputs.c"
#include "law_defaults.c"
#include "law_status.c"
#include "limits.c"
#include "outputs.c"
#include "watchdog.c"

/* == Declarations == */

/* One compensator with its gains, its guards and its state. To be read: `faults`, the bits of this tick;
 * `seen`, of all ticks since reset; `cause`, the bits that tripped it, 0 if nothing has. */
typedef struct {
    uint32_t faults, seen, cause;
    bool usable, stopped;
    jaxhil_clock clock;
    jaxhil_bias_tare tare;
    jaxhil_input_guard inputs;
    jaxhil_watchdog watchdog;
    jaxhil_force_guard forces;
    jaxhil_position_guard positions;
    jaxhil_law law;
} jaxhil_controller;

/* Begin with these gains and limits. False if they are not admitted, or ask for a longer delay than this
 * code holds: the controller then stays tripped, with the cause JAXHIL_UNUSABLE. */
bool jaxhil_init(jaxhil_controller *controller, const jaxhil_gains *gains, const jaxhil_limits *limits);

/* Take in one reading [N] of the force sensor out of contact; true once there are enough. To be called once
 * a tick before a run: their mean is then taken from every reading, until the next tare. */
bool jaxhil_tare(jaxhil_controller *controller, double force_measured);

/* The force [N] that the numerical model is to feel this tick, from force [N], positions [m] and velocity
 * [m/s]. With `time` [s], which may be NULL, ticks that come late or were missed are seen. */
double jaxhil_step(jaxhil_controller *controller, double force_measured, double position_desired,
                   double velocity_desired, double position_measured, const double *time);

/* The position [m] to command, from the numerical model's motion [m, m/s, m/s^2] after this tick's step. Whatever it
 * is given, it is at most `velocity_limit` times the period from the last command. A run's first command is as near
 * to the measured position; out of contact, where drives in motion follow late, it may be within `start_distance` of
 * it. Before a run's first step, the model's position, if it is out of contact, is taken for where the rig has been
 * brought to. A trip leads away from the last command, without one from the position measured last, without either
 * from a place out of contact. */
double jaxhil_position_command(jaxhil_controller *controller, double position, double velocity,
                               double acceleration);

/* Tell the controller the state of the rig's emergency stop: active, it trips, and the force and the position
 * command come to rest; then `jaxhil_at_rest` and the drives may be switched off. Released, the trip stays
 * latched until `jaxhil_reset`, which is refused before. */
void jaxhil_emergency_stop(jaxhil_controller *controller, bool active);

/* Restart everything but the tare: filters, identified parameters, a trip, the count of ticks. Without a
 * bump: force and position command go on from the last ones. If the drives have been moved since by other means,
 * call jaxhil_next_contact as well. Refused, with false, while the emergency stop is active. */
bool jaxhil_reset(jaxhil_controller *controller);

/* Begin a fresh run for the next contact, the rig having been brought to its start: the first position command goes
 * on from where the drives then read, not from the last command. Identified parameters carry over, a trip stays
 * latched. A contact still under way is audited first: what that finds is in `faults`
 * until the next step. */
void jaxhil_next_contact(jaxhil_controller *controller);

/* Whether a fault has tripped the controller since the last reset. */
bool jaxhil_tripped(const jaxhil_controller *controller);

/* Whether, after a trip, the position command has come to rest. */
bool jaxhil_at_rest(const jaxhil_controller *controller);

/* The force sensor's bias [N] that the last good tare found. */
double jaxhil_bias(const jaxhil_controller *controller);

/* The control periods since reset without a tick, and the ticks that came late. */
int64_t jaxhil_missed_ticks(const jaxhil_controller *controller);
int64_t jaxhil_late_ticks(const jaxhil_controller *controller);

/* Identified stiffness [N/m] and damping [N s/m]; 0 and 0 if the law identifies none. */
void jaxhil_identified(const jaxhil_controller *controller, double *stiffness, double *damping);

/* Estimated delay [s] of the force measurement; 0 if the law estimates none. */
double jaxhil_force_delay(const jaxhil_controller *controller);

/* What the law says of the last command; JAXHIL_UNSTATED if it says nothing. */
int jaxhil_law_status(const jaxhil_controller *controller);

/* What the law said of the contact audited last, whatever follows, reset included, until the next one is. */
jaxhil_contact_record jaxhil_last_contact(const jaxhil_controller *controller);

/* == Definitions == */

static void jaxhil_fail(jaxhil_controller *controller, uint32_t cause) {
    /* The first cause is the one to look at: what follows a trip may follow from it. */
    if (!controller->cause) {
        controller->cause = cause;
    }
    controller->faults |= cause;
    controller->seen |= controller->faults;
}

static void jaxhil_restart(jaxhil_controller *controller) {
    jaxhil_clock_reset(&controller->clock);
    jaxhil_bias_tare_begin(&controller->tare);
    jaxhil_input_guard_restart(&controller->inputs);
    jaxhil_watchdog_restart(&controller->watchdog);
    jaxhil_force_guard_restart(&controller->forces);
    jaxhil_position_guard_restart(&controller->positions);
    controller->cause = 0;
    controller->faults = 0;
    controller->seen = 0;
}

static bool jaxhil_guards_init(jaxhil_controller *controller, const jaxhil_limits *limits, double period,
                               double clearance, bool stated) {
    jaxhil_clock_init(&controller->clock, limits, period);
    jaxhil_bias_tare_init(&controller->tare, limits);
    jaxhil_input_guard_init(&controller->inputs, limits, period, clearance);
    jaxhil_force_guard_init(&controller->forces, limits, period);
    jaxhil_position_guard_init(&controller->positions, limits, period, clearance);
    return jaxhil_watchdog_init(&controller->watchdog, limits, period, clearance, stated);
}

bool jaxhil_init(jaxhil_controller *controller, const jaxhil_gains *gains, const jaxhil_limits *limits) {
    controller->usable = jaxhil_gains_admitted(gains) && jaxhil_limits_fit(limits) &&
                         jaxhil_law_init(&controller->law, gains) &&
                         jaxhil_guards_init(controller, limits, gains->control_period, gains->clearance,
                                            jaxhil_law_own_status(&controller->law) != JAXHIL_UNSTATED);
    controller->stopped = false;
    if (controller->usable) {
        jaxhil_law_reset(&controller->law);
        jaxhil_restart(controller);
    } else {
        jaxhil_guards_init(controller, &jaxhil_no_limits, 1.0, INFINITY, false);
        jaxhil_restart(controller);
        jaxhil_fail(controller, JAXHIL_UNUSABLE);
    }
    return controller->usable;
}

bool jaxhil_tare(jaxhil_controller *controller, double force_measured) {
    if (controller->cause) {
        return true;
    }
    const bool over = jaxhil_bias_tare_take(&controller->tare, force_measured);
    if (controller->tare.fatal) {
        jaxhil_fail(controller, JAXHIL_TARE);
    }
    return over;
}

double jaxhil_step(jaxhil_controller *controller, double force_measured, double position_desired,
                   double velocity_desired, double position_measured, const double *time) {
    jaxhil_force_guard *forces = &controller->forces;
    jaxhil_input_guard *inputs = &controller->inputs;
    uint32_t faults = 0;
    uint32_t fatal = 0;
    controller->faults = 0;
    jaxhil_input_guard_locate(inputs, position_measured);
    if (controller->cause) {
        jaxhil_force_guard_fade(forces);
        return forces->output;
    }
    if (time != NULL) {
        faults = jaxhil_clock_tick(&controller->clock, *time);
        if (controller->clock.fatal) {
            fatal = faults;
        }
    }
    faults |= jaxhil_input_guard_check(inputs, force_measured, position_desired, velocity_desired,
                                       position_measured, controller->tare.bias);
    fatal |= inputs->fatal;
    if (controller->watchdog.on && !fatal) {
        const uint32_t found = jaxhil_watchdog_tick(
            &controller->watchdog, forces->output, jaxhil_law_own_status(&controller->law), inputs->force,
            position_desired, velocity_desired, inputs->measured);
        faults |= found;
        fatal = found & ~(uint32_t)JAXHIL_LAW_IN_DOUBT;
    }
    if (!fatal) {
        const double command = jaxhil_law_step(&controller->law, inputs->force, position_desired,
                                               velocity_desired, inputs->measured);
        faults |= jaxhil_force_guard_limit(forces, command);
        fatal = forces->fatal;
    }
    controller->faults = faults;
    controller->seen |= faults;
    if (fatal) {
        jaxhil_fail(controller, fatal);
        jaxhil_force_guard_fade(forces);
    }
    return forces->output;
}

/* The law's position command [m] for a motion; not a number if that has none. */
static double jaxhil_sent(jaxhil_controller *controller, double position, double velocity, double acceleration) {
    const bool finite = isfinite(position) && isfinite(velocity) && isfinite(acceleration);
    return finite ? jaxhil_law_position_command(&controller->law, position, velocity, acceleration) : NAN;
}

double jaxhil_position_command(jaxhil_controller *controller, double position, double velocity,
                               double acceleration) {
    jaxhil_position_guard *positions = &controller->positions;
    const double measured = controller->inputs.located;
    if (!controller->cause) {
        const double command = jaxhil_sent(controller, position, velocity, acceleration);
        const uint32_t faults = jaxhil_position_guard_limit(positions, command, position, measured,
                                                            controller->inputs.is_located);
        controller->faults |= faults;
        controller->seen |= faults;
        if (!positions->fatal) {
            return positions->output;
        }
        jaxhil_fail(controller, positions->fatal);
    }
    jaxhil_position_guard_retreat(positions, measured, position);
    return positions->output;
}

void jaxhil_emergency_stop(jaxhil_controller *controller, bool active) {
    controller->stopped = active;
    if (active) {
        jaxhil_fail(controller, JAXHIL_EMERGENCY_STOP);
    }
}

bool jaxhil_reset(jaxhil_controller *controller) {
    if (controller->stopped || !controller->usable) {
        return false;
    }
    jaxhil_law_reset(&controller->law);
    jaxhil_restart(controller);
    return true;
}

void jaxhil_next_contact(jaxhil_controller *controller) {
    if (controller->cause) {
        return;
    }
    const uint32_t faults = jaxhil_watchdog_conclude(&controller->watchdog, controller->forces.output,
                                                     jaxhil_law_own_status(&controller->law));
    const uint32_t fatal = faults & ~(uint32_t)JAXHIL_LAW_IN_DOUBT;
    controller->faults = faults;
    controller->seen |= faults;
    if (fatal) {
        jaxhil_fail(controller, fatal);
        return;
    }
    jaxhil_law_next_contact(&controller->law);
    jaxhil_clock_pause(&controller->clock);
    jaxhil_input_guard_restart(&controller->inputs);
    controller->inputs.is_located = false;
    jaxhil_watchdog_restart(&controller->watchdog);
    jaxhil_position_guard_release(&controller->positions);
}

bool jaxhil_tripped(const jaxhil_controller *controller) {
    return controller->cause != 0;
}

bool jaxhil_at_rest(const jaxhil_controller *controller) {
    return controller->cause != 0 && controller->positions.at_rest;
}

double jaxhil_bias(const jaxhil_controller *controller) {
    return controller->tare.bias;
}

int64_t jaxhil_missed_ticks(const jaxhil_controller *controller) {
    return controller->clock.missed;
}

int64_t jaxhil_late_ticks(const jaxhil_controller *controller) {
    return controller->clock.late;
}

void jaxhil_identified(const jaxhil_controller *controller, double *stiffness, double *damping) {
    *stiffness = 0.0;
    *damping = 0.0;
    if (controller->usable) {
        jaxhil_law_identified(&controller->law, stiffness, damping);
    }
}

int jaxhil_law_status(const jaxhil_controller *controller) {
    return controller->usable ? jaxhil_law_own_status(&controller->law) : JAXHIL_UNSTATED;
}

jaxhil_contact_record jaxhil_last_contact(const jaxhil_controller *controller) {
    return controller->watchdog.record;
}

double jaxhil_force_delay(const jaxhil_controller *controller) {
    return controller->usable ? jaxhil_law_force_delay(&controller->law) : 0.0;
}

