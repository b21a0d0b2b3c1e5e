/* Index of each quantity's first column; a vector has six columns. */
enum {
    RUN = 0,
    EVENT = 1,
    WRENCH_MEASURED = 2,
    POSE_DESIRED = 8,
    TWIST_DESIRED = 14,
    POSE_MEASURED = 20,
    TIME = 26,
    POSE = 27,
    TWIST = 33,
    WRENCH_COMMAND = 39,
    POSE_COMMAND = 45,
    FAULTS = 51,
    WRENCH_SIMULATED = 52,
    COLUMNS = 58
};

static const char header[] =
    "run,event,wrench_measured_x,wrench_measured_y,wrench_measured_z,wrench_measured_rx,"
    "wrench_measured_ry,wrench_measured_rz,pose_desired_x,pose_desired_y,pose_desired_z,"
    "pose_desired_rx,pose_desired_ry,pose_desired_rz,twist_desired_x,twist_desired_y,twist_desired_z,"
    "twist_desired_rx,twist_desired_ry,twist_desired_rz,pose_measured_x,pose_measured_y,"
    "pose_measured_z,pose_measured_rx,pose_measured_ry,pose_measured_rz,time,pose_x,pose_y,pose_z,"
    "pose_rx,pose_ry,pose_rz,twist_x,twist_y,twist_z,twist_rx,twist_ry,twist_rz,wrench_command_x,"
    "wrench_command_y,wrench_command_z,wrench_command_rx,wrench_command_ry,wrench_command_rz,"
    "pose_command_x,pose_command_y,pose_command_z,pose_command_rx,pose_command_ry,pose_command_rz,"
    "faults,wrench_simulated_x,wrench_simulated_y,wrench_simulated_z,wrench_simulated_rx,"
    "wrench_simulated_ry,wrench_simulated_rz";

static bool start(void) {
    return jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits,
                       &jaxhil_exported_constants);
}

static void next_contact(void) {
    jaxhil_next_contact(&controller);
}

/* Pass one row to the controller; return 0 if the results equal those of the row. */
static int replay(const char *name, long number, const double *row, const int *given) {
    double wrench[6], pose[6];
    jaxhil_step(&controller, row + WRENCH_MEASURED, row + POSE_DESIRED, row + TWIST_DESIRED,
                row + POSE_MEASURED, given[TIME] ? &row[TIME] : NULL, wrench);
    jaxhil_pose_command(&controller, row + POSE, row + TWIST, pose);
    const double faults = (double)controller.faults;
    for (int axis = 0; axis < 6; axis++) {
        if (!is_same(wrench[axis], row[WRENCH_COMMAND + axis])) {
            return differs(name, number, "wrench_command", wrench[axis], row[WRENCH_COMMAND + axis]);
        }
        if (!is_same(pose[axis], row[POSE_COMMAND + axis])) {
            return differs(name, number, "pose_command", pose[axis], row[POSE_COMMAND + axis]);
        }
    }
    return is_same(faults, row[FAULTS]) ? 0 : differs(name, number, "faults", faults, row[FAULTS]);
}
