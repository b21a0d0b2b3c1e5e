/* One control period of the rig with six axes, as a step of an FMU: the equations of `jaxhil simulate`.
 *
 * The functions of rig_program.c integrate the numerical model, move the hardware, and read the sensors.
 */
#include "fmu.h"
#include "fmu_log.h"

const char *const fmu_log_columns = "";
const char *const fmu_log_mapping = "";

size_t fmu_model_row(const fmu_state *state, double *row) {
    (void)state, (void)row; /* the rig has no log */
    return 0;
}

/* Read the sensors after the motion to `numbers`, and set the outputs. */
static void set_outputs(fmu_state *state, const double *numbers) {
    const uint32_t key[2] = {(uint32_t)state->values[V_SEED], 0};
    rig_sense(numbers, key, state->model.numbers, state->values + V_WRENCH_MEASURED_FX);
}

void fmu_model_initial(fmu_state *state) {
    set_outputs(state, rig_start);
}

bool fmu_model_begin(fmu_state *state) {
    (void)state; /* each parameter has bounds of its own */
    return true;
}

void fmu_model_step(fmu_state *state) {
    double moved[RIG_NUMBERS];
    rig_move(state->model.numbers, state->values + V_WRENCH_COMMAND_FX, state->values + V_POSE_COMMAND_X, moved);
    set_outputs(state, moved);
}
