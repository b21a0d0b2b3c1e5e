/* What the retrospective references share: find the surface, identify the contact, work out what should have
 * happened, pay it back. Until the force tells of contact F_c = 0. In contact F_c = f_0 + (y - F(X, V)) + f_e,
 * f_0 = clip(F(x_d, v_d), 0, most p), F the force-depth map identified on delay-aligned readings (X, V, y) since the
 * surface was met; separated f_0 = 0 and F_c = f_e until the hardware has left the surface for 6 ms, then 0. f_e =
 * clip((v_d - T f_0/2 - v_r)/(1/c + s t), -limit p, (1 + limit) p - f_0), v_r the speed of the motion that the
 * contact should have had since its entry, p the peak force that the map predicts, t the time left of 2/p since the
 * hardware's entry. Scaled by approach speed and equivalent mass. Slow contact is followed on a slower scale of time:
 * with T and 1/c times its pace, v0 over it, it is as usual contact.
 */
#include <math.h>
#include <stdbool.h>

#include "balance.c"
#include "contact_plane.c"
#include "contact_readings.c"
#include "doubts.c"
#include "gains_table.c"
#include "history.c"
#include "onset.c"
#include "readings.c"
#include "reintegration.c"
#include "surfaces.c"

/* == Declarations == */

typedef struct {
    double period, clearance, mass, dead_zone, floor, velocity_gain, share, limit, replay, strength;
    double plane_spread, bias_spread;
    double pace, side, speed, gone, deepest, hardware_deepest, learnt_deepest;
    long next;
    jaxhil_plane planes[2]; /* where the surfaces on both sides are expected */
    jaxhil_alignment alignment;
    jaxhil_force_noise noise;
    jaxhil_learnt learnt;
    jaxhil_reference_motion reference;
    jaxhil_history history;
    jaxhil_onset onset;
    jaxhil_doubts doubts;
    jaxhil_balance balance;
    bool started;
    int status;
} jaxhil_law;

/* == Definitions == */

static const double jaxhil_farewell = 0.006;  /* s for which it goes on after the hardware has left */
static const double jaxhil_usual_pace = 14.0; /* 1/s: slower contact is followed on a slower scale of time */
static const double jaxhil_slowest = 0.01;    /* of that */
static const double jaxhil_most = 1.2;        /* of the peak force, that the model is to feel of the map */
static const double jaxhil_margin = 0.0625;   /* of the stretch between two samples, off whose end the surface is */
static const double jaxhil_least_weight = 1e-9; /* kg m/s, mass times approach speed: less does not scale */
enum { JAXHIL_READINGS = 2 };                 /* per tick that the map learns from, while it has to catch up */

/* All but what was learnt of earlier contacts. */
static void jaxhil_law_restart(jaxhil_law *law) {
    law->side = 0.0;
    law->speed = 0.0;
    law->gone = 0.0;
    law->deepest = 0.0;
    law->hardware_deepest = 0.0;
    jaxhil_force_noise_restart(&law->noise);
    jaxhil_history_restart(&law->history);
    jaxhil_onset_restart(&law->onset);
    jaxhil_doubts_restart(&law->doubts);
    jaxhil_balance_restart(&law->balance);
    law->started = false;
    law->status = JAXHIL_OUT_OF_CONTACT;
}

static void jaxhil_law_forget_planes(jaxhil_law *law) {
    for (int i = 0; i < 2; i++) {
        law->planes[i].place = 0.0;
        law->planes[i].spread = law->plane_spread;
    }
    law->reference.scales.plane = 0.0;
    law->reference.scales.length = 1.0;
}

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    const double period = gains->control_period;
    law->period = period;
    law->clearance = gains->clearance;
    law->mass = gains->equivalent_mass;
    law->noise.known = gains->force_noise * gains->force_noise;
    law->dead_zone = gains->dead_zone;
    law->floor = gains->force_noise_floor;
    law->velocity_gain = gains->velocity_gain;
    law->share = gains->repayment_time;
    law->limit = gains->correction_limit;
    law->replay = gains->force_replay;
    law->strength = gains->replay_noise * gains->replay_noise;
    law->plane_spread = gains->plane_spread;
    law->bias_spread = gains->bias_spread;
    jaxhil_doubts_start(&law->doubts, 0.0, 0.0);
    jaxhil_learnt_init(&law->learnt, gains);
    jaxhil_reference_motion_init(&law->reference, period);
    law->reference.scales.clearance = law->clearance;
    law->onset.period = period;
    jaxhil_law_forget_planes(law);
    jaxhil_law_restart(law);
    return jaxhil_alignment_init(&law->alignment, gains->identification_delay, period);
}

/* f_e [1/s], by the map's peak force, f_0 and the speed of the model in the middle of the next period; `status` judges
 * it. */
static double jaxhil_law_repayment(jaxhil_law *law, double peak, double own, double speed, double zone) {
    const jaxhil_reference_motion *reference = &law->reference;
    const double least = -(law->limit * peak), most = (1.0 + law->limit) * peak - own;
    /* Elastic contact of this peak lasts no less. */
    const double left = 2.0 / peak - (double)(law->history.newest - reference->entry) * reference->period;
    const double gain = law->velocity_gain / law->pace;
    const double slower = 1.0 + gain * (law->share * (left > 0.0 ? left : 0.0));
    const double correction = gain * (speed - reference->live.speed) / slower;
    law->status =
        jaxhil_doubts_status(&law->doubts, peak, jaxhil_learnt_variance(&law->learnt), zone, law->speed);
    if (!(correction > most || correction < least)) {
        return correction;
    }
    law->status = law->status == JAXHIL_IDENTIFIED ? JAXHIL_SATURATED : law->status;
    return correction > most ? most : least;
}

/* The map learns from the readings since the surface was met, one after the other; noise of a `variance` [1/s^2],
 * the dead zone [1/s]. */
static void jaxhil_law_learn(jaxhil_law *law, double variance, double zone) {
    const jaxhil_reference_motion *reference = &law->reference;
    for (int i = 0; i < JAXHIL_READINGS && law->next <= law->history.newest; i++, law->next++) {
        const jaxhil_reading one = jaxhil_reading_at(&law->history, &reference->scales, law->next, variance,
                                                     jaxhil_misfit, reference->period);
        if (one.depth > law->learnt_deepest) {
            law->learnt_deepest = one.depth;
        }
        law->doubts.readings += one.depth > 0.0 && one.shown;
        if (one.shown) {
            jaxhil_balance_take(&law->balance, jaxhil_learnt_curve(&law->learnt), one.depth,
                                reference->shift * one.rate + reference->deeper, one.rate, law->learnt_deepest,
                                one.force, one.variance, jaxhil_learnt_variance(&law->learnt));
        }
        jaxhil_learnt_read(&law->learnt, one.depth, one.rate, law->learnt_deepest, one.force, one.variance,
                           !one.shown, zone);
    }
    jaxhil_learnt_check(&law->learnt, &law->history, &reference->scales, reference->entry, variance, JAXHIL_READINGS);
}

/* The command over M v0 [1/s]; whether the numerical model has separated. */
static double jaxhil_law_follow(jaxhil_law *law, double x, double v, double depth, double rate, double force,
                                bool hidden, bool *separated) {
    jaxhil_reference_motion *reference = &law->reference;
    const double weight = reference->scales.weight;
    const jaxhil_curve *curve = jaxhil_learnt_curve(&law->learnt);
    if (x > law->deepest) {
        law->deepest = x;
    }
    if (depth > law->hardware_deepest) {
        law->hardware_deepest = depth;
    }
    const double zone = law->dead_zone / weight;
    const double noise = jaxhil_force_noise_variance(&law->noise) / (weight * weight);
    reference->shift = jaxhil_learnt_shift(&law->learnt);
    reference->deeper = jaxhil_learnt_deeper(&law->learnt);
    jaxhil_law_learn(law, law->floor * law->floor + noise, zone);
    const double expected = jaxhil_curve_force(curve, depth, rate, law->hardware_deepest);
    if (hidden) {
        force = expected > zone ? zone : (expected > 0.0 ? expected : 0.0);
    }
    const double whole = law->strength + noise;
    reference->replay = whole > 0.0 ? law->replay * law->strength / whole : 0.0;
    jaxhil_reference_motion_tick(reference, &law->history, curve);

    double own = jaxhil_curve_force(curve, x, v, law->deepest);
    *separated = x <= 0.0 || (v < 0.0 && own <= 0.0);
    if (!(own > 0.0)) {
        own = 0.0;
    }
    const double peak = jaxhil_curve_peak_force(curve);
    const double felt = jaxhil_most * peak;
    if (own > felt) {
        own = felt;
    }
    law->doubts.unexplained =
        jaxhil_balance_unexplained(&law->balance, curve, peak, law->learnt_deepest, reference->shift, law->pace) ||
        jaxhil_learnt_open(&law->learnt, peak);
    const double middle = v - 0.5 * reference->period * own;
    const double correction = jaxhil_law_repayment(law, peak, *separated ? 0.0 : own, middle, zone);
    return *separated ? correction : own + (force - expected) + correction;
}

#define JAXHIL_LAW_HAS_CONTACT_PLANE
/* By how much [m] the surface is deeper than told. */
static double jaxhil_law_contact_plane(const jaxhil_law *law) {
    const jaxhil_scales *scales = &law->reference.scales;
    return scales->plane + jaxhil_learnt_deeper(&law->learnt) * scales->length;
}

/* A surface is found, met between two samples: between them it lies where it was most expected. */
static void jaxhil_law_meet(jaxhil_law *law, double side, double reach, double speed, jaxhil_found found) {
    jaxhil_history *history = &law->history;
    jaxhil_scales *scales = &law->reference.scales;
    jaxhil_plane *plane = &law->planes[side < 0.0];
    const long entry = history->newest - found.age;
    const double pace = sqrt(found.stiffness > 0.0 ? found.stiffness : 0.0) / jaxhil_usual_pace;
    law->pace = pace < 1.0 ? (pace > jaxhil_slowest ? pace : jaxhil_slowest) : 1.0;
    law->reference.period = law->period * law->pace;
    scales->side = side;
    scales->speed = speed;
    scales->length = speed / law->pace;
    scales->bias = side * found.bias * (law->mass * speed);
    scales->weight = law->mass * speed * law->pace;
    const double low = jaxhil_scales_beyond(scales, jaxhil_history_recall(history, entry)->position);
    const double high = jaxhil_scales_beyond(scales, jaxhil_history_recall(history, entry + 1)->position);
    const double width = high - low;
    jaxhil_plane_learn(plane, low, high, jaxhil_plane_found(width, found.age));
    /* Not at the end of the stretch: the reference would not have entered. */
    const double end = high - jaxhil_margin * width;
    scales->plane = plane->place < low ? low : (plane->place > end ? end : plane->place);
    const double since = high > low ? (high - scales->plane) / width : 0.5;
    const double tick = law->reference.period;
    const double stiffness = found.stiffness / (law->pace * law->pace);
    const double met = 0.5 * (low + high) - found.earlier * width;
    const double around = width * width * (1.0 / 12.0 + found.variance);
    const jaxhil_meeting meeting = {scales->plane, met, around, speed, law->pace, tick, stiffness};
    const double variance =
        law->floor * law->floor + jaxhil_force_noise_variance(&law->noise) / (scales->weight * scales->weight);
    const long earlier = jaxhil_learnt_begin(&law->learnt, &meeting, history, scales, variance);
    const double depth = (reach - scales->plane) / scales->length - jaxhil_learnt_deeper(&law->learnt);
    const double far = jaxhil_far * law->plane_spread;
    const double place = jaxhil_law_contact_plane(law);
    law->side = side;
    law->speed = speed;
    law->gone = 0.0;
    law->deepest = law->hardware_deepest = law->learnt_deepest = 0.0;
    law->next = entry + 1 - (earlier < entry ? earlier : entry);
    jaxhil_doubts_restart(&law->doubts);
    jaxhil_balance_restart(&law->balance);
    law->doubts.late = depth - (double)found.age * law->reference.period;
    law->doubts.displaced = place > far || place < -far;
    jaxhil_reference_motion_begin(&law->reference, history, entry, since, depth > 0.0 ? depth : 0.0);
}

/* Of a reading and of the bias the variance [1/s^2], flying with this speed [m/s]. */
static void jaxhil_law_uncertain(const jaxhil_law *law, double speed, double *noise, double *unknown) {
    const double weight = law->mass * speed;
    const double spread = law->bias_spread / weight;
    *noise = law->floor * law->floor + jaxhil_force_noise_variance(&law->noise) / (weight * weight);
    *unknown = spread * spread;
}

/* Flying to the surface on this side with this speed [m/s]: that it was met so many ticks ago is `found` if that is
 * more evident. */
static void jaxhil_law_suppose(const jaxhil_law *law, double side, double speed, long age, jaxhil_found *found) {
    double noise, unknown;
    jaxhil_law_uncertain(law, speed, &noise, &unknown);
    const jaxhil_plane *plane = &law->planes[side < 0.0];
    const double position = jaxhil_history_recall(&law->history, law->history.newest - age)->position;
    const double place = (side < 0.0 ? -law->clearance - position : position) - plane->place;
    const double away = place / plane->spread;
    const double rarity = jaxhil_map_pi * plane->spread * (1.0 + away * away) / (law->period * speed);
    jaxhil_found one;
    one.age = age;
    one.evidence = jaxhil_onset_evidence(&law->onset, age, noise, unknown, rarity, &one);
    if (one.evidence > found->evidence) {
        *found = one;
    }
}

/* Whether the force tells that the surface was met. */
static bool jaxhil_law_watch(jaxhil_law *law, double side, double speed, double force, bool shown,
                             jaxhil_found *found) {
    jaxhil_onset_take(&law->onset, side * force / (law->mass * speed), shown);
    found->evidence = jaxhil_onset_certain;
    found->age = 0;
    long below = 0, above = 0;
    for (int i = 1; i <= JAXHIL_AGES && jaxhil_ages[i] < law->onset.watched; i++) {
        jaxhil_law_suppose(law, side, speed, jaxhil_ages[i], found);
        if (found->age == jaxhil_ages[i]) {
            below = jaxhil_ages[i - 1];
            above = jaxhil_ages[i + 1];
        }
    }
    for (long step = JAXHIL_AGE_STEP; step > 0 && found->age > 0; step /= 2) {
        const long middle = found->age;
        for (long age = middle - step; age <= middle + step; age += 2 * step) {
            if (age > below && age < above && age < law->onset.watched) {
                jaxhil_law_suppose(law, side, speed, age, found);
            }
        }
    }
    if (!(found->age > 1 && (double)found->age * law->period >= jaxhil_onset_wait * (1.0 - 1e-9))) {
        return false;
    }
    double noise, unknown;
    jaxhil_law_uncertain(law, speed, &noise, &unknown);
    jaxhil_onset_spread(&law->onset, noise, unknown, found);
    return true;
}

/* Flying freely: whether the force tells that a surface was met; if so, the contact begins. */
static bool jaxhil_law_meets(jaxhil_law *law, double force, bool shown, double position_desired,
                             double velocity_desired) {
    const double side = velocity_desired > 0.0 ? 1.0 : -1.0;
    const double speed = side * velocity_desired;
    jaxhil_found found = {0, 0.0, 0.0, 0.0, 0.0, 0.0};
    law->status = JAXHIL_OUT_OF_CONTACT;
    if (!(law->mass * speed > jaxhil_least_weight) || (side < 0.0 && law->clearance == INFINITY)) {
        jaxhil_onset_restart(&law->onset);
        return false;
    }
    if (!jaxhil_law_watch(law, side, speed, force, shown, &found)) {
        return false;
    }
    const double reach = side < 0.0 ? -law->clearance - position_desired : position_desired;
    jaxhil_law_meet(law, side, reach, speed, found);
    return true;
}

/* The force as it is read, in a run that begins in contact; whether the numerical model has separated. */
static double jaxhil_law_pass_on(jaxhil_law *law, double force, double reach, double position,
                                 bool *separated) {
    const double bent = law->side * jaxhil_deflection(position, law->clearance);
    *separated = !(reach * law->side > 0.0);
    law->gone = bent > 0.0 ? 0.0 : law->gone;
    law->status = JAXHIL_UNSURE;
    return *separated || bent < 0.0 ? 0.0 : force;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    const double zone = law->dead_zone;
    const bool begins = !law->started;
    double position, velocity;
    jaxhil_alignment_step(&law->alignment, position_measured, velocity_desired, begins, &position, &velocity);
    if (begins) {
        const double stride = law->period * velocity_desired;
        jaxhil_doubts_start(&law->doubts, position_measured - stride, stride);
        law->started = true;
    }
    jaxhil_doubts_move(&law->doubts, position_measured);
    /* A run's first reading counts as none: the sensor's delay line may not have been filled. */
    const bool hidden = begins || (zone > 0.0 && force_measured == 0.0);
    const double force =
        force_measured + (force_measured > 0.0 ? zone : (force_measured < 0.0 ? -zone : 0.0));
    jaxhil_history_take(&law->history, force, !hidden, position, velocity);
    jaxhil_force_noise_take(&law->noise, force, !hidden, law->side == 0.0);
    const double reach = jaxhil_deflection(position_desired, law->clearance);
    if (begins) {
        law->side = reach > 0.0 ? 1.0 : (reach < 0.0 ? -1.0 : 0.0);
    }
    if (law->side == 0.0 && !jaxhil_law_meets(law, force, !hidden, position_desired, velocity_desired)) {
        return 0.0;
    }
    bool separated;
    double command;
    law->gone += 1.0;
    if (law->speed > 0.0) {
        const jaxhil_scales *scales = &law->reference.scales;
        const double rate = jaxhil_scales_rate(scales, velocity);
        const double deeper = jaxhil_learnt_deeper(&law->learnt);
        const double moved = jaxhil_learnt_shift(&law->learnt) * rate + deeper;
        const double given = jaxhil_scales_depth(scales, position) - moved;
        const double depth = given >= -jaxhil_map_surface && given <= jaxhil_map_surface ? 0.0 : given;
        if (depth > 0.0) {
            law->gone = 0.0;
        }
        command = jaxhil_law_follow(law, jaxhil_scales_depth(scales, position_desired) - deeper,
                                    jaxhil_scales_rate(scales, velocity_desired), depth, rate,
                                    jaxhil_scales_force(scales, force), hidden, &separated);
        command = law->side * scales->weight * command;
    } else {
        command = jaxhil_law_pass_on(law, force, reach, position, &separated);
    }
    if (separated && law->gone * law->period > jaxhil_farewell * (1.0 + 1e-9)) {
        law->side = 0.0;
        law->speed = 0.0;
        law->status = JAXHIL_OUT_OF_CONTACT;
        jaxhil_onset_restart(&law->onset);
        return 0.0;
    }
    return command;
}

#define JAXHIL_LAW_HAS_STATUS
static int jaxhil_law_own_status(const jaxhil_law *law) {
    return law->status;
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_law_restart(law);
    jaxhil_law_forget_planes(law);
    jaxhil_learnt_reset(&law->learnt);
}

#define JAXHIL_LAW_HAS_NEXT_CONTACT
static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_law_restart(law);
}
