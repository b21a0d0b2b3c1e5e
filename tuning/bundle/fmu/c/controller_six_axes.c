/* One tick of the controller on six axes, as a step of an FMU.
 *
 * The six components of a vector are successive variables.
 */
#include "controller_events.h"

void fmu_model_initial(fmu_state *state) {
    memcpy(state->values + V_POSE_COMMAND_X, state->values + V_POSE_X, 6 * sizeof(double));
}

bool fmu_model_begin(fmu_state *state) {
    jaxhil_gains gains;
    jaxhil_limits limits;
    copy_parameters(state, &gains, &limits);
    state->model.stopped = false;
    return jaxhil_init(&state->model.controller, &gains, &limits, &jaxhil_exported_constants);
}

void fmu_model_step(fmu_state *state) {
    double *const values = state->values;
    jaxhil_controller *const controller = &state->model.controller;
    apply_events(state);
    if (values[V_TARE] != 0.0) {
        values[V_TARE_DONE] = jaxhil_tare(controller, values + V_WRENCH_MEASURED_FX) ? 1.0 : 0.0;
    } else {
        values[V_TARE_DONE] = 0.0;
        jaxhil_step(controller, values + V_WRENCH_MEASURED_FX, values + V_POSE_DESIRED_X,
                    values + V_TWIST_DESIRED_VX, values + V_POSE_MEASURED_X,
                    values[V_HAS_TICK_TIME] != 0.0 ? &values[V_TICK_TIME] : NULL,
                    values + V_WRENCH_COMMAND_FX);
        jaxhil_pose_command(controller, values + V_POSE_X, values + V_TWIST_VX, values + V_POSE_COMMAND_X);
    }
    jaxhil_bias(controller, values + V_WRENCH_BIAS_FX);
    values[V_CHANNELS] = (double)jaxhil_channels(controller);
    values[V_LOOP_DELAY] = jaxhil_loop_delay(controller);
    values[V_UNPAID_IMPULSE] = jaxhil_unpaid_impulse(controller);
    set_statuses(state);
}

size_t fmu_model_row(const fmu_state *state, double *row) {
    const double *const values = state->values;
    return fill_row(state, values + V_WRENCH_MEASURED_FX, values + V_WRENCH_BIAS_FX, values + V_WRENCH_COMMAND_FX,
                    6, row);
}
