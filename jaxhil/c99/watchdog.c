/* The watchdog: an energy audit of every contact, from the motion of the numerical model.
 *
 * A contact begins where the model or the hardware is beyond a surface as told, or the law acts. It is audited
 * once that has not been so for `settling`, the model moves away and the force on it has died out; at the latest
 * in the middle of the gap or when the next contact is announced.
 * The model's kinetic energy must have changed by the work of the force that the controller gave, and the
 * restitution must be the one expected of a contact of the identified stiffness. A law that has a status says
 * whether it knew the contact; this is asked without the equivalent mass too.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "faults_table.c"
#include "filters.c"
#include "law_status.c"
#include "limits_table.c"
#include "surfaces.c"

/* == Declarations == */

/* One contact after another, audited. To be read: `contacts`, those audited since init; of the last of them
 * `record`, what the law said of it, and until a restart its `restitution`, the `expected` one and the energy out
 * of `balance` [J]. */
typedef struct {
    double restitution, expected, balance;
    int64_t contacts;
    jaxhil_contact_record record;
    bool on, stated, known, open, measured;
    double clearance, middle, period, mass, quiet_ticks, faded, longest, fading, margin, tolerance;
    double entry, side, velocity, force, aligned, peak, unfelt, work;
    double sxx, sxv, svv, sxf, svf;
    int64_t quiet, ticks;
    jaxhil_contact_record statuses;
    jaxhil_limits limits;
    jaxhil_delay_line alignment;
    double samples[JAXHIL_ALIGNMENT_SAMPLES];
} jaxhil_watchdog;

/* == Definitions == */

#define JAXHIL_FADED 1e-6   /* of the largest force, and impulse of the rest over that of the approach */
#define JAXHIL_PATIENCE 0.1 /* s, that the force is given to die out */

static void jaxhil_watchdog_clear(jaxhil_watchdog *watchdog) {
    watchdog->quiet = 0;
    watchdog->ticks = 0;
    watchdog->peak = 0.0;
    watchdog->unfelt = 0.0;
    watchdog->work = 0.0;
    watchdog->measured = false;
    watchdog->statuses = jaxhil_contact_record_begin(0, JAXHIL_UNSTATED);
    watchdog->sxx = 0.0;
    watchdog->sxv = 0.0;
    watchdog->svv = 0.0;
    watchdog->sxf = 0.0;
    watchdog->svf = 0.0;
}

static void jaxhil_watchdog_restart(jaxhil_watchdog *watchdog) {
    jaxhil_watchdog_clear(watchdog);
    watchdog->known = false;
    watchdog->open = false;
    watchdog->entry = 0.0;
    watchdog->side = 1.0;
    watchdog->velocity = 0.0;
    watchdog->force = 0.0;
    watchdog->aligned = 0.0;
    watchdog->balance = 0.0;
    watchdog->expected = 0.0;
    watchdog->restitution = 0.0;
}

/* False if the alignment is longer than its line. `stated`: whether the law has a status. */
static bool jaxhil_watchdog_init(jaxhil_watchdog *watchdog, const jaxhil_limits *limits, double period,
                                 double clearance, bool stated) {
    watchdog->on = stated || limits->equivalent_mass > 0.0;
    watchdog->stated = stated;
    watchdog->clearance = clearance;
    watchdog->middle = -0.5 * clearance;
    watchdog->period = period;
    watchdog->mass = limits->equivalent_mass;
    watchdog->quiet_ticks = limits->settling / period;
    watchdog->faded = (limits->settling + JAXHIL_PATIENCE) / period;
    watchdog->longest = limits->equivalent_mass > 0.0 ? limits->longest_contact / period : INFINITY;
    watchdog->fading = limits->fading;
    watchdog->margin = limits->restitution_margin;
    watchdog->tolerance = limits->energy_balance;
    watchdog->limits = *limits;
    watchdog->contacts = 0;
    watchdog->record = jaxhil_contact_record_begin(0, JAXHIL_UNSTATED);
    jaxhil_watchdog_restart(watchdog);
    return jaxhil_delay_line_init(&watchdog->alignment, watchdog->samples, JAXHIL_ALIGNMENT_SAMPLES,
                                  limits->alignment, period);
}

/* Written so that what is not a number goes to an end as well. */
static double jaxhil_within(double value, double lowest, double highest) {
    if (!(value > lowest)) {
        return lowest;
    }
    return value < highest ? value : highest;
}

/* The restitution that a contact should have, by its stiffness [N/m], damping [N s/m], speed [m/s]. */
static double jaxhil_expected(const jaxhil_limits *c, double stiffness, double damping, double speed,
                              double mass) {
    double p = c->softness_highest;
    double z = c->loss_lowest;
    const double root = stiffness > 0.0 ? sqrt(stiffness * mass) : 0.0;
    if (root > 0.0) {
        p = jaxhil_within(sqrt(c->reference_stiffness / stiffness) - 1.0, c->softness_lowest,
                          c->softness_highest);
        z = jaxhil_within(damping / (2.0 * root), c->loss_lowest, c->loss_highest);
    }
    const double w =
        jaxhil_within(speed / c->reference_velocity - 1.0, c->speed_lowest, c->speed_highest);
    const double expected = c->expected_1 +
                            p * (c->expected_p + p * (c->expected_pp + p * c->expected_ppp)) +
                            w * (c->expected_w + w * c->expected_ww + p * c->expected_pw);
    return jaxhil_within(expected + z * (c->expected_z + z * c->expected_zz + p * c->expected_pz +
                                         w * c->expected_wz),
                         0.0, 1.0);
}

static uint32_t jaxhil_watchdog_energies(jaxhil_watchdog *watchdog, double velocity) {
    const double entry = watchdog->entry;
    const double mass = watchdog->mass;
    const double energy = 0.5 * mass * entry * entry;
    watchdog->balance = 0.5 * mass * velocity * velocity - energy + watchdog->work;
    if (!(fabs(watchdog->balance) <= watchdog->tolerance * energy)) {
        return JAXHIL_ENERGY_BALANCE;
    }
    const double speed = fabs(entry);
    if (speed == 0.0) {
        return 0;
    }
    const double determinant = watchdog->sxx * watchdog->svv - watchdog->sxv * watchdog->sxv;
    double stiffness = 0.0;
    double damping = 0.0;
    if (determinant > 0.0) {
        stiffness = (watchdog->sxf * watchdog->svv - watchdog->svf * watchdog->sxv) / determinant;
        damping = (watchdog->svf * watchdog->sxx - watchdog->sxf * watchdog->sxv) / determinant;
    }
    watchdog->restitution = fabs(velocity) / speed;
    watchdog->expected = jaxhil_expected(&watchdog->limits, stiffness, damping, speed, mass);
    if (!(fabs(watchdog->restitution - watchdog->expected) <= watchdog->margin)) {
        return JAXHIL_RESTITUTION;
    }
    return 0;
}

static uint32_t jaxhil_watchdog_audit(jaxhil_watchdog *watchdog, double velocity) {
    uint32_t doubt = 0;
    watchdog->open = false;
    watchdog->contacts++;
    if (watchdog->stated) {
        watchdog->statuses.number = watchdog->contacts;
        doubt = jaxhil_contact_record_end(&watchdog->statuses, watchdog->measured) ? JAXHIL_LAW_IN_DOUBT : 0;
        watchdog->record = watchdog->statuses;
    }
    return doubt | (watchdog->mass > 0.0 ? jaxhil_watchdog_energies(watchdog, velocity) : 0);
}

/* Audit the contact under way, if there is one, after the force `given` [N] on the last tick and the law's
 * `status` then. */
static uint32_t jaxhil_watchdog_conclude(jaxhil_watchdog *watchdog, double given, int status) {
    if (!watchdog->open) {
        return 0;
    }
    jaxhil_contact_record_take(&watchdog->statuses, status);
    const double before = watchdog->velocity;
    if (!(watchdog->mass > 0.0)) {
        return jaxhil_watchdog_audit(watchdog, before);
    }
    const double velocity = before - watchdog->period * given / watchdog->mass;
    watchdog->work += watchdog->period * given * 0.5 * (before + velocity);
    return jaxhil_watchdog_audit(watchdog, velocity);
}

/* Take in the interval between two ticks, if both its ends are in contact. */
static void jaxhil_watchdog_regress(jaxhil_watchdog *watchdog, double force, double deflection) {
    /* Not by the force as well: of noisy readings it would pick the larger ones, and bias the stiffness. */
    const double side = watchdog->side;
    const double before = watchdog->aligned;
    if (deflection * side > 0.0 && before * side > 0.0) {
        const double middle = side * (deflection + before) * 0.5;
        const double rate = side * (deflection - before) / watchdog->period;
        const double mean = side * (force + watchdog->force) * 0.5;
        watchdog->sxx += middle * middle;
        watchdog->sxv += middle * rate;
        watchdog->svv += rate * rate;
        watchdog->sxf += middle * mean;
        watchdog->svf += rate * mean;
    }
}

/* One tick of a contact that is under way: its faults. */
static uint32_t jaxhil_watchdog_follow(jaxhil_watchdog *watchdog, double given, double before, double velocity,
                                       double side, bool in_contact) {
    const double size = fabs(given);
    watchdog->quiet = in_contact ? 0 : watchdog->quiet + 1;
    watchdog->ticks++;
    watchdog->work += watchdog->period * given * 0.5 * (before + velocity);
    if (size > watchdog->peak) {
        watchdog->peak = size;
    }
    const bool faded = size <= JAXHIL_FADED * watchdog->peak || size <= watchdog->unfelt ||
                       (double)watchdog->quiet >= watchdog->faded;
    const bool outside = !in_contact && (double)watchdog->quiet >= watchdog->quiet_ticks;
    const bool leaving = outside && watchdog->side * velocity < 0.0 && faded;
    if (leaving || side != watchdog->side) {
        return jaxhil_watchdog_audit(watchdog, velocity);
    }
    return (double)watchdog->ticks > watchdog->longest ? JAXHIL_CONTACT_TOO_LONG : 0;
}

/* The faults that this tick shows, 0 if none. `given` [N] is the force that the controller gave on the tick
 * before, `status` what the law said of it, `force` [N] and `measured` [m] are this tick's readings, the rest the
 * numerical model's. */
static uint32_t jaxhil_watchdog_tick(jaxhil_watchdog *watchdog, double given, int status, double force,
                                     double position, double velocity, double measured) {
    double before = watchdog->velocity;
    if (!watchdog->known) {
        watchdog->known = true;
        jaxhil_delay_line_start(&watchdog->alignment, watchdog->samples, measured, velocity);
        before = velocity;
        given = 0.0;
    }
    const double aligned = jaxhil_delay_line_step(&watchdog->alignment, watchdog->samples, measured);
    const double deflection = jaxhil_deflection(aligned, watchdog->clearance);
    const bool in_contact = jaxhil_deflection(position, watchdog->clearance) != 0.0 ||
                          jaxhil_deflection(measured, watchdog->clearance) != 0.0 ||
                          (status != JAXHIL_UNSTATED && status != JAXHIL_OUT_OF_CONTACT);
    const double side = position > watchdog->middle ? 1.0 : -1.0;
    uint32_t fault = 0;
    if (!watchdog->open && in_contact) {
        jaxhil_watchdog_clear(watchdog);
        watchdog->open = true;
        watchdog->entry = before;
        watchdog->unfelt = JAXHIL_FADED * watchdog->mass * fabs(before) / JAXHIL_PATIENCE;
        watchdog->side = side;
    }
    if (watchdog->open) {
        jaxhil_contact_record_take(&watchdog->statuses, status);
        watchdog->measured = watchdog->measured || fabs(force) > watchdog->fading;
        jaxhil_watchdog_regress(watchdog, force, deflection);
        fault = jaxhil_watchdog_follow(watchdog, given, before, velocity, side, in_contact);
    }
    watchdog->velocity = velocity;
    watchdog->force = force;
    watchdog->aligned = deflection;
    return fault;
}
