/* See rt_task.h. If readings are missing, the answers are those of udp_task.py. */
#include "rt_task.h"

#include <string.h>

#include "jaxhil_gains.h"
#include "rt_log.h"
#include "rt_model.h"

#define MAX_INTERPOLATED 10.0  /* ticks without readings in a row that are interpolated */
#define MAX_COASTED 10000u     /* periods in which the model continues under the last force */

static struct {
    uint32_t run, tick, contact, faults;
    readings last; /* of the last tick */
    bool has_run, is_tared;
} loop;

static double *put(double *to, const double *from) {
    memcpy(to, from, AXES * sizeof *from);
    return to + AXES;
}

/* Tare the sensor while the drives wait, then place the model at the start of the run. Return the flags, or 0 if
 * the start is unusable. */
static unsigned prepare(const readings *now) {
    if (now->event == RESET && (!loop.has_run || now->run != loop.run)) {
        jaxhil_reset(&rt_controller);
    }
    if (loop.has_run && now->run == loop.run) {
        return READY;
    }
    loop.is_tared = loop.is_tared || rt_tare(now->force);
    if (!loop.is_tared) {
        return TARING;
    }
    if (!rt_place(now->start)) {
        return 0;
    }
    if (loop.has_run && !jaxhil_tripped(&rt_controller)) {
        jaxhil_next_contact(&rt_controller);
        loop.faults = rt_controller.faults;
    }
    rt_begin();
    loop.contact += loop.has_run;
    loop.has_run = true;
    loop.run = now->run;
    loop.tick = UINT32_MAX; /* the tick before tick 0 */
    return READY;
}

/* Step controller and model by one tick; add a row to the log. */
static void tick(const double *force, const double *position, double time, bool is_first) {
    log_row row = {{time}, loop.contact, 0};
    double bias[AXES], *values = row.values + 1;
    rt_bias(bias);
    for (int n = 0; n < AXES; n++) {
        *values++ = force[n] - bias[n];
    }
    values = put(put(put(values, rt_model.position), rt_model.velocity), position);
    rt_tick(force, position, time, is_first);
    put(values, rt_model.force);
    row.faults = rt_controller.faults | rt_controller.cause;
    loop.faults |= rt_controller.faults;
    add_row(&row);
}

/* Make up for ticks whose readings are missing. Execute a few ticks with interpolated readings. If more ticks
 * are missing, only the model moves, under the last force, and the controller detects the gap in the time. */
static void catch_up(const readings *now, uint32_t missed) {
    const double most = jaxhil_exported_limits.missed_in_a_row;
    const readings *const last = loop.tick != UINT32_MAX ? &loop.last : now;
    loop.faults = missed > 0 ? JAXHIL_MISSED_TICK : 0;
    if ((double)missed > (most < MAX_INTERPOLATED ? most : MAX_INTERPOLATED)) {
        for (uint32_t n = 0; n < missed && n < MAX_COASTED; n++) {
            rt_coast();
        }
        return;
    }
    for (uint32_t n = 0; n < missed; n++) {
        const double weight = (double)(n + 1) / (double)(missed + 1);
        double force[AXES], position[AXES];
        for (int axis = 0; axis < AXES; axis++) {
            force[axis] = last->force[axis] + weight * (now->force[axis] - last->force[axis]);
            position[axis] = last->position[axis] + weight * (now->position[axis] - last->position[axis]);
        }
        tick(force, position, now->time - (double)(missed - n) * PERIOD, loop.tick + 1 + n == 0);
    }
}

bool rt_answer(const readings *now, commands *answer) {
    memset(answer, 0, sizeof *answer);
    loop.faults = 0;
    if (now->event != TICK) {
        answer->flags = prepare(now);
        if (answer->flags == 0) {
            return false;
        } else if (answer->flags & READY) {
            rt_rate(answer->rate);
        }
    } else if (!loop.has_run || now->run != loop.run || (int32_t)(now->tick - loop.tick) <= 0) {
        return false;
    } else {
        catch_up(now, now->tick - loop.tick - 1);
    }
    put(answer->model_position, rt_model.position);
    put(answer->model_velocity, rt_model.velocity);
    if (now->event == TICK) {
        double before[AXES];
        put(before, rt_model.command);
        tick(now->force, now->position, now->time, now->tick == 0);
        loop.tick = now->tick;
        loop.last = *now;
        rt_rate(answer->rate);
        for (int n = 0; n < AXES && jaxhil_tripped(&rt_controller); n++) {
            answer->rate[n] = (rt_model.command[n] - before[n]) / PERIOD;
        }
        put(answer->force, rt_model.force);
    }
    put(answer->position, rt_model.command);
    answer->faults = loop.faults;
    answer->cause = rt_controller.cause;
    answer->flags |= jaxhil_tripped(&rt_controller) ? TRIPPED : 0;
    return true;
}

bool rt_is_at_rest(void) {
    bool is_free = true;
    for (int n = 0; n < AXES; n++) {
        is_free = is_free && rt_model.force[n] == 0.0;
    }
    return !loop.has_run || (is_free && jaxhil_at_rest(&rt_controller));
}
