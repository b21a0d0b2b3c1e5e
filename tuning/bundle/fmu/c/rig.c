/* One control period of the rig, as a step of an FMU: the same equations as `jaxhil simulate`.
 *
 * A step integrates the numerical model under the force command, moves the hardware by the position command,
 * and reads the sensors at the end of the period.
 */
#include <float.h>
#include <math.h>

#include "fmu.h"
#include "fmu_log.h"

const char *const fmu_log_columns = "";
const char *const fmu_log_mapping = "";

size_t fmu_model_row(const fmu_state *state, double *row) {
    (void)state, (void)row; /* the rig has no log */
    return 0;
}

static const double approach_time = 0.02; /* time from the start of a run to the contact [s] */
static const double two_pi = 6.283185307179586;

static size_t ring_index(int64_t tick) {
    return (size_t)tick & (RIG_RING - 1);
}

/* Scalar product of a row of coefficients and the simulator's state and the commands of an interval. */
static double evaluate(const double row[RIG_ORDER + 2], const double *state, double start, double end) {
    double total = row[RIG_ORDER] * start + row[RIG_ORDER + 1] * end;
    for (int n = 0; n < RIG_ORDER; n++) {
        total += row[n] * state[n];
    }
    return total;
}

static motion_state motion(const double rows[2][RIG_ORDER + 2], const double *state, double start, double end) {
    motion_state result;
    result.position = evaluate(rows[0], state, start, end) - RIG_PLANE;
    result.velocity = evaluate(rows[1], state, start, end);
    return result;
}

/* Uniform random number in (0, 1), by the generator SplitMix64. */
static double draw(fmu_model *rig) {
    uint64_t bits = rig->noise += 0x9E3779B97F4A7C15u;
    bits = (bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9u;
    bits = (bits ^ (bits >> 27)) * 0x94D049BB133111EBu;
    bits ^= bits >> 31;
    return ((double)(bits >> 11) + 0.5) / 9007199254740992.0;
}

/* Normal random number with this standard deviation (Box and Muller 1958). */
static double draw_noise(fmu_model *rig, double deviation) {
    double first, second;
    if (!(deviation > 0.0)) {
        return 0.0;
    }
    first = draw(rig);
    second = draw(rig);
    return deviation * sqrt(-2.0 * log(first)) * cos(two_pi * second);
}

static double quantise(double value, double quantum) {
    return quantum > 0.0 ? quantum * nearbyint(value / quantum) : value;
}

/* Begin a run in uniform motion without contact, at this velocity of the numerical model [m/s]. */
static void begin_run(fmu_state *state, double velocity) {
    fmu_model *const rig = &state->model;
    const double *const values = state->values;
    const double stride = RIG_PERIOD * velocity;
    const double nearer = RIG_PLANE < 0.0 ? RIG_PLANE : 0.0;
    const double start = nearer - velocity * (approach_time + values[V_APPROACH_PHASE] * RIG_PERIOD);
    const double command = start - stride; /* of the last period before the run */
    const double drive = command - RIG_LATENCY * stride + (RIG_LINEAR_HOLD ? 0.0 : stride);
    double before[RIG_ORDER];
    double first;
    rig->model.position = start;
    rig->model.velocity = velocity;
    rig->model.acceleration = 0.0;
    rig->law = contact_law_of((int)values[V_CONTACT]);
    for (int n = 0; n <= RIG_LATENCY; n++) {
        rig->commands[n] = command - n * stride;
    }
    rig->requested = command;
    rig->step = stride;
    rig->shortfall = 0.0;
    for (int n = 0; n < RIG_ORDER; n++) {
        before[n] = rig_steady_command[n] * (drive - stride) + rig_steady_step[n] * stride;
        rig->simulator[n] = rig_steady_command[n] * drive + rig_steady_step[n] * stride;
    }
    first = evaluate(rig_measured, before, drive - stride, RIG_LINEAR_HOLD ? drive : drive - stride);
    for (int n = 0; n < RIG_RING; n++) {
        rig->forces[n] = 0.0;
        rig->intervals[n].is_used = false;
        rig->positions[n] = first + (n - RIG_RING + 1) * stride;
        rig->drives[n] = rig->commands[RIG_LATENCY] + (n - RIG_RING + 1) * stride;
    }
    rig->tick = 0;
    rig->lag = rig->force = rig->deepest = 0.0;
    rig->in_contact = false;
}

/* Limit the rates of a position command [m]. */
static double limit_command(fmu_model *rig, double requested) {
    const double previous = rig->commands[0], before = rig->requested;
    const double largest = RIG_VELOCITY_LIMIT * RIG_PERIOD;
    const double change = RIG_ACCELERATION_LIMIT * RIG_PERIOD * RIG_PERIOD;
    const double requested_step = requested - before, unlimited = requested - previous;
    double step = unlimited, command = requested, rounding;
    if (isfinite(change)) {
        const double behind = before - previous;
        const double more = floor((sqrt(1.0 + 8.0 * fabs(behind) / change) - 1.0) / 2.0);
        step = requested_step + behind / (more + 1.0) + copysign(change * more / 2.0, behind);
        step = fmin(fmax(step, rig->step - change), rig->step + change);
    }
    step = fmin(fmax(step, -largest), largest);
    rounding = 2.0 * DBL_EPSILON * (fabs(requested) + fabs(previous) + fabs(requested_step));
    if (fabs(step - unlimited) <= rounding) {
        step = unlimited;
    } else {
        command = previous + step;
    }
    rig->requested = requested;
    rig->step = step;
    rig->shortfall = fabs(requested - command);
    return command;
}

/* Deepest penetration [m] of the contact until `end`; 0 if the contact has ended by then. */
static double deepest_until(const contact_law *law, double deepest, motion_state start, motion_state end,
                            double duration) {
    if (-RIG_CLEARANCE <= end.position && end.position <= 0.0) {
        return 0.0;
    }
    return duration <= 0.0 ? deepest : fmax(deepest, deepest_penetration(law, start, end, duration));
}

/* Compute the contact in a sampling interval; return the output of the force sensor's lag [N]. */
static double contact_force(fmu_model *rig, const sampling_interval *interval) {
    const double rest = RIG_PERIOD - RIG_SAMPLE_TIME, deepest = rig->deepest;
    const motion_state sample = interval->sample;
    contact_law law = rig->law;
    double reading;
    if (!interval->is_used) {
        return 0.0;
    }
    if (contact_law_has_memory()) {
        law.deepest = deepest_until(&rig->law, deepest, interval->start, sample, RIG_SAMPLE_TIME);
        rig->deepest = deepest_until(&law, law.deepest, sample, interval->end, rest);
    }
    rig->in_contact = sample.position > 0.0 || sample.position < -RIG_CLEARANCE;
    rig->force = sample.position > 0.0 ? contact_law_force(&law, sample.position, sample.velocity)
                 : rig->in_contact
                     ? -contact_law_force(&law, -RIG_CLEARANCE - sample.position, -sample.velocity)
                     : 0.0;
    if (RIG_TIME_CONSTANT == 0.0) {
        return rig->force;
    }
    reading = apply_sensor_lag(rig->lag, &rig->law, interval->start, sample, RIG_SAMPLE_TIME, deepest);
    rig->lag = apply_sensor_lag(reading, &rig->law, sample, interval->end, rest, law.deepest);
    return reading;
}

/* Move the hardware by one period. */
static void move_hardware(fmu_model *rig, double command) {
    double start, end, next[RIG_ORDER];
    sampling_interval *const interval = &rig->intervals[ring_index(rig->tick)];
    if (isfinite(RIG_VELOCITY_LIMIT) || isfinite(RIG_ACCELERATION_LIMIT)) {
        command = limit_command(rig, command);
    }
    end = RIG_LATENCY > 0 ? rig->commands[RIG_LATENCY - 1 + (RIG_LATENCY == 0)] : command;
    start = RIG_LINEAR_HOLD ? rig->commands[RIG_LATENCY] : end;
    for (int n = RIG_LATENCY; n > 0; n--) {
        rig->commands[n] = rig->commands[n - 1];
    }
    rig->commands[0] = command;
    rig->drives[ring_index(rig->tick)] = end;
#if RIG_WINDOW_INTERVALS >= 0
    for (int n = 0; n < 3; n++) { /* the commands between which the window's start moves */
        rig->simulator[1 + n] = rig->drives[ring_index(rig->tick - RIG_WINDOW_INTERVALS - 2 + n)];
    }
#endif
    interval->is_used = true;
    interval->start = motion(rig_start, rig->simulator, start, end);
    interval->sample = motion(rig_sample, rig->simulator, start, end);
    interval->end = motion(rig_end, rig->simulator, start, end);
    rig->positions[ring_index(rig->tick)] = evaluate(rig_measured, rig->simulator, start, end);
    for (int n = 0; n < RIG_ORDER; n++) {
        next[n] = evaluate(rig_transition[n], rig->simulator, start, end);
    }
    for (int n = 0; n < RIG_ORDER; n++) {
        rig->simulator[n] = next[n];
    }
    rig->forces[ring_index(rig->tick)] =
        contact_force(rig, &rig->intervals[ring_index(rig->tick - RIG_CONTACT_INTERVALS)]);
    rig->tick++;
}

/* Read the sensors, and set the outputs. */
static void set_outputs(fmu_state *state) {
    fmu_model *const rig = &state->model;
    double *const values = state->values;
    double force = rig->forces[ring_index(rig->tick - 1 - RIG_FORCE_INTERVALS)] + RIG_FORCE_BIAS;
    double position = rig->positions[ring_index(rig->tick - 1 - RIG_POSITION_INTERVALS)];
    force = quantise(force + draw_noise(rig, values[V_FORCE_NOISE]), RIG_FORCE_QUANTUM);
    if (RIG_DEAD_ZONE_CUTS) {
        force = fabs(force) > RIG_DEAD_ZONE ? force : 0.0;
    } else if (RIG_DEAD_ZONE > 0.0) {
        force = copysign(fmax(0.0, fabs(force) - RIG_DEAD_ZONE), force);
    }
    values[V_FORCE_MEASURED] = fmin(fmax(force, -RIG_FORCE_RANGE), RIG_FORCE_RANGE);
    position = quantise(position + draw_noise(rig, values[V_POSITION_NOISE]), RIG_POSITION_QUANTUM);
    values[V_POSITION_MEASURED] = position;
    values[V_POSITION] = rig->model.position;
    values[V_VELOCITY] = rig->model.velocity;
    values[V_ACCELERATION] = rig->model.acceleration;
    values[V_CONTACT_FORCE] = rig->force;
    values[V_POSITION_SHORTFALL] = rig->shortfall;
}

void fmu_model_initial(fmu_state *state) {
    state->model.noise = (uint64_t)state->values[V_SEED];
    begin_run(state, state->values[V_APPROACH_VELOCITY]);
    set_outputs(state);
}

bool fmu_model_begin(fmu_state *state) {
    (void)state; /* each parameter has bounds of its own */
    return true;
}

void fmu_model_step(fmu_state *state) {
    fmu_model *const rig = &state->model;
    if (state->values[V_NEXT_RUN] != 0.0) {
        begin_run(state, fabs(rig->model.velocity)); /* the speed at which the last run ended */
    } else {
        move_model(&rig->model, RIG_INTEGRATOR, RIG_PERIOD, state->values[V_FORCE_COMMAND],
                   state->values[V_EQUIVALENT_MASS]);
        move_hardware(rig, state->values[V_POSITION_COMMAND]);
    }
    if (!rig->in_contact && (int)state->values[V_CONTACT] != rig->law.number) {
        rig->law = contact_law_of((int)state->values[V_CONTACT]);
    }
    set_outputs(state);
}
