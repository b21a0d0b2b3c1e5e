/* One tick of the controller on six axes, as a step of an FMU.
 *
 * The six components of a vector are successive variables.
 */
#include "controller_events.h"

static const rigid_body bodies[2] = FMU_BODIES;

void fmu_model_initial(fmu_state *state) {
    double *const values = state->values;
    const bool integrates = values[V_INTEGRATES_MODEL] != 0.0;
    const double *const pose = values + (integrates ? V_POSE_DESIRED_X : V_POSE_X);
    const double *const twist = values + (integrates ? V_TWIST_DESIRED_VX : V_TWIST_VX);
    memcpy(values + V_POSE_COMMAND_X, pose, 6 * sizeof *pose);
    memcpy(values + V_MODEL_POSE_X, pose, 6 * sizeof *pose);
    memcpy(values + V_MODEL_TWIST_VX, twist, 6 * sizeof *twist);
    if (integrates && fmu_model_begin(state)) {
        /* The first command includes the compensator's lead. The second initialisation forgets this command. */
        jaxhil_pose_command(&state->model.controller, pose, twist, values + V_POSE_COMMAND_X);
        fmu_model_begin(state);
    }
}

bool fmu_model_begin(fmu_state *state) {
    jaxhil_gains gains;
    jaxhil_limits limits;
    copy_parameters(state, &gains, &limits);
    state->model.stopped = false;
    state->model.begins = true;
    return jaxhil_init(&state->model.controller, &gains, &limits, &jaxhil_exported_constants);
}

/* Compute one tick. The numerical model is that of the FMU, or `model` has its newest motion from the inputs. */
static void tick(fmu_state *state, bool integrates, numerical_model *model) {
    double *const values = state->values;
    jaxhil_controller *const controller = &state->model.controller;
    double *const pose = state->model.position_desired, *const twist = state->model.velocity_desired;
    memcpy(pose, integrates ? model->pose : values + V_POSE_DESIRED_X, 6 * sizeof *pose);
    memcpy(twist, integrates ? model->twist : values + V_TWIST_DESIRED_VX, 6 * sizeof *twist);
    jaxhil_step(controller, values + V_WRENCH_MEASURED_FX, pose, twist, values + V_POSE_MEASURED_X,
                values[V_HAS_TICK_TIME] != 0.0 ? &values[V_TICK_TIME] : NULL, values + V_WRENCH_COMMAND_FX);
    if (integrates) {
        move_model(bodies, FMU_VELOCITY_SHARE, FMU_PERIOD, values + V_WRENCH_COMMAND_FX, model);
    }
    jaxhil_pose_command(controller, model->pose, model->twist, values + V_POSE_COMMAND_X);
    memcpy(values + V_MODEL_POSE_X, model->pose, sizeof model->pose);
    memcpy(values + V_MODEL_TWIST_VX, model->twist, sizeof model->twist);
}

void fmu_model_step(fmu_state *state) {
    double *const values = state->values;
    fmu_model *const model = &state->model;
    apply_events(state);
    if (values[V_TARE] != 0.0) {
        values[V_TARE_DONE] = jaxhil_tare(&model->controller, values + V_WRENCH_MEASURED_FX) ? 1.0 : 0.0;
    } else {
        const bool integrates = values[V_INTEGRATES_MODEL] != 0.0;
        if (integrates && (model->begins || values[V_NEXT_CONTACT] != 0.0)) {
            place_model(bodies, values + V_POSE_DESIRED_X, values + V_TWIST_DESIRED_VX,
                        values + V_TARGET_ANGULAR_VELOCITY_WX, &model->model);
        } else if (!integrates) {
            memcpy(model->model.pose, values + V_POSE_X, sizeof model->model.pose);
            memcpy(model->model.twist, values + V_TWIST_VX, sizeof model->model.twist);
        }
        model->begins = false;
        values[V_TARE_DONE] = 0.0;
        tick(state, integrates, &model->model);
    }
    jaxhil_bias(&model->controller, values + V_WRENCH_BIAS_FX);
    values[V_CHANNELS] = (double)jaxhil_channels(&model->controller);
    values[V_LOOP_DELAY] = jaxhil_loop_delay(&model->controller);
    values[V_UNPAID_IMPULSE] = jaxhil_unpaid_impulse(&model->controller);
    set_statuses(state);
}

size_t fmu_model_row(const fmu_state *state, double *row) {
    const double *const values = state->values;
    double readings[24];
    memcpy(readings, values + V_WRENCH_MEASURED_FX, 6 * sizeof *readings);
    memcpy(readings + 6, state->model.position_desired, 6 * sizeof *readings);
    memcpy(readings + 12, state->model.velocity_desired, 6 * sizeof *readings);
    memcpy(readings + 18, values + V_POSE_MEASURED_X, 6 * sizeof *readings);
    return fill_row(state, readings, values + V_WRENCH_BIAS_FX, values + V_WRENCH_COMMAND_FX, 6, row);
}
