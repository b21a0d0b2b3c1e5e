/* One tick of the controller on one axis, as a step of an FMU. */
#include "controller_events.h"

void fmu_model_initial(fmu_state *state) {
    double *const values = state->values;
    const bool integrates = values[V_INTEGRATES_MODEL] != 0.0;
    values[V_POSITION_COMMAND] = values[V_MODEL_POSITION] =
        integrates ? values[V_POSITION_DESIRED] : values[V_POSITION];
    values[V_MODEL_VELOCITY] = integrates ? values[V_VELOCITY_DESIRED] : values[V_VELOCITY];
}

bool fmu_model_begin(fmu_state *state) {
    jaxhil_gains gains;
    jaxhil_limits limits;
    copy_parameters(state, &gains, &limits);
    state->model.stopped = false;
    state->model.begins = true;
    return jaxhil_init(&state->model.controller, &gains, &limits);
}

/* Compute one tick. The numerical model is that of the FMU, or `model` has its motion from the inputs. */
static void tick(fmu_state *state, bool integrates, numerical_model *model) {
    double *const values = state->values;
    jaxhil_controller *const controller = &state->model.controller;
    const double position = integrates ? model->position : values[V_POSITION_DESIRED];
    const double velocity = integrates ? model->velocity : values[V_VELOCITY_DESIRED];
    state->model.position_desired[0] = position;
    state->model.velocity_desired[0] = velocity;
    values[V_FORCE_COMMAND] =
        jaxhil_step(controller, values[V_FORCE_MEASURED], position, velocity, values[V_POSITION_MEASURED],
                    values[V_HAS_TICK_TIME] != 0.0 ? &values[V_TICK_TIME] : NULL);
    if (integrates) {
        move_model(model, FMU_INTEGRATOR, FMU_PERIOD, values[V_FORCE_COMMAND], values[V_EQUIVALENT_MASS]);
    }
    values[V_POSITION_COMMAND] =
        jaxhil_position_command(controller, model->position, model->velocity, model->acceleration);
    values[V_MODEL_POSITION] = model->position;
    values[V_MODEL_VELOCITY] = model->velocity;
}

void fmu_model_step(fmu_state *state) {
    double *const values = state->values;
    fmu_model *const model = &state->model;
    apply_events(state);
    if (values[V_TARE] != 0.0) {
        values[V_TARE_DONE] = jaxhil_tare(&model->controller, values[V_FORCE_MEASURED]) ? 1.0 : 0.0;
    } else {
        const bool integrates = values[V_INTEGRATES_MODEL] != 0.0;
        if (integrates && (model->begins || values[V_NEXT_CONTACT] != 0.0)) {
            model->model.position = values[V_POSITION_DESIRED];
            model->model.velocity = values[V_VELOCITY_DESIRED];
        } else if (!integrates) {
            model->model.position = values[V_POSITION];
            model->model.velocity = values[V_VELOCITY];
            model->model.acceleration = values[V_ACCELERATION];
        }
        model->begins = false;
        values[V_TARE_DONE] = 0.0;
        tick(state, integrates, &model->model);
    }
    values[V_FORCE_BIAS] = jaxhil_bias(&model->controller);
    values[V_FORCE_DELAY] = jaxhil_force_delay(&model->controller);
    jaxhil_identified(&model->controller, &values[V_STIFFNESS], &values[V_DAMPING]);
    set_statuses(state);
}

size_t fmu_model_row(const fmu_state *state, double *row) {
    const double *const values = state->values;
    const double readings[4] = {values[V_FORCE_MEASURED], state->model.position_desired[0],
                                state->model.velocity_desired[0], values[V_POSITION_MEASURED]};
    return fill_row(state, readings, &values[V_FORCE_BIAS], &values[V_FORCE_COMMAND], 1, row);
}
