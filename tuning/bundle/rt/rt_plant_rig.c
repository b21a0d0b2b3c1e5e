/* Simulated rig inside the loop's program, for a rehearsal without Python and without a second process.
 *
 * The rig is that of jaxhil_rig.fmu. It moves by one period when the loop sends its commands: a deadline that the
 * loop misses delays the rig, and no tick is lost. The drives wait until the controller is ready. A run ends
 * after tick LAST_TICK; on one axis, it ends earlier if the numerical model was behind its start for BEHIND_TICKS
 * ticks. The next run begins at the same state, with other noise. After a trip, the run goes on until the stop.
 */
#include <string.h>

#include "fmu.h"
#include "rt_loop.h"
#include "rt_plant_rig.h"

typedef struct {
    fmu_state state;
    readings now;
    double seed;      /* of the noise */
    uint64_t periods; /* since the start of the loop */
    uint32_t behind;  /* ticks of this run in which the numerical model was behind its start */
} rig_plant;

static rig_plant the_plant;

/* Place the rig at the start of the run. */
static void place_rig(rig_plant *rig) {
    rig->state.values[V_SEED] = rig->seed++;
    rig->state.values[CONTACT] = (rig->now.run - 1) % CONTACTS;
    fmu_model_initial(&rig->state);
}

/* Prepare the next run: the drives wait. */
static void prepare_run(rig_plant *rig) {
    rig->now.event = PREPARE;
    rig->now.run++;
    rig->now.tick = rig->behind = 0;
    place_rig(rig);
}

static bool rig_open(void *plant) {
    static const double start[START_VALUES] = RUN_START;
    rig_plant *const rig = (rig_plant *)plant;
    for (size_t n = 0; n < V_COUNT; n++) {
        rig->state.values[n] = fmu_variables[n].start;
    }
    memcpy(rig->now.start, start, sizeof start);
    prepare_run(rig);
    return true;
}

static bool rig_read(void *plant, readings *now) {
    rig_plant *const rig = (rig_plant *)plant;
    memcpy(rig->now.force, rig->state.values + FORCE, sizeof rig->now.force);
    memcpy(rig->now.position, rig->state.values + POSITION, sizeof rig->now.position);
    rig->now.time = (double)rig->periods++ * PERIOD;
    *now = rig->now;
    return true;
}

static bool rig_write(void *plant, const commands *answer) {
    rig_plant *const rig = (rig_plant *)plant;
    if (rig->now.event == PREPARE && !(answer->flags & READY)) {
        place_rig(rig);
        return true;
    }
    memcpy(rig->state.values + FORCE_COMMAND, answer->force, sizeof answer->force);
    memcpy(rig->state.values + POSITION_COMMAND, answer->position, sizeof answer->position);
    fmu_model_step(&rig->state); /* before tick 0, to the command of tick 0 */
    if (rig->now.event == PREPARE) {
        rig->now.event = TICK;
        return true;
    }
    rig->behind += AXES == 1 && answer->model_position[0] < rig->now.start[0];
    rig->now.tick++;
    if (!(answer->flags & TRIPPED) && (rig->now.tick > LAST_TICK || rig->behind >= BEHIND_TICKS)) {
        prepare_run(rig);
    }
    return true;
}

static void rig_close(void *plant) { (void)plant; }

bool rt_plant_option(const char *name, const char *value) {
    (void)name, (void)value;
    return false;
}

const plant_io rt_plant = {rig_open, rig_read, rig_write, rig_close, &the_plant};
