/* One tick of the controller on one axis, as a step of an FMU. */
#include "controller_events.h"

void fmu_model_initial(fmu_state *state) {
    state->values[V_POSITION_COMMAND] = state->values[V_POSITION];
}

bool fmu_model_begin(fmu_state *state) {
    jaxhil_gains gains;
    jaxhil_limits limits;
    copy_parameters(state, &gains, &limits);
    state->model.stopped = false;
    return jaxhil_init(&state->model.controller, &gains, &limits);
}

void fmu_model_step(fmu_state *state) {
    double *const values = state->values;
    jaxhil_controller *const controller = &state->model.controller;
    apply_events(state);
    if (values[V_TARE] != 0.0) {
        values[V_TARE_DONE] = jaxhil_tare(controller, values[V_FORCE_MEASURED]) ? 1.0 : 0.0;
    } else {
        values[V_TARE_DONE] = 0.0;
        values[V_FORCE_COMMAND] =
            jaxhil_step(controller, values[V_FORCE_MEASURED], values[V_POSITION_DESIRED],
                        values[V_VELOCITY_DESIRED], values[V_POSITION_MEASURED],
                        values[V_HAS_TICK_TIME] != 0.0 ? &values[V_TICK_TIME] : NULL);
        values[V_POSITION_COMMAND] = jaxhil_position_command(controller, values[V_POSITION], values[V_VELOCITY],
                                                             values[V_ACCELERATION]);
    }
    values[V_FORCE_BIAS] = jaxhil_bias(controller);
    values[V_FORCE_DELAY] = jaxhil_force_delay(controller);
    jaxhil_identified(controller, &values[V_STIFFNESS], &values[V_DAMPING]);
    set_statuses(state);
}
