enum {
    RUN, EVENT, FORCE_MEASURED, POSITION_DESIRED, VELOCITY_DESIRED, POSITION_MEASURED, TIME,
    POSITION, VELOCITY, ACCELERATION, FORCE_COMMAND, POSITION_COMMAND, FAULTS, FORCE_SIMULATED, COLUMNS
};

static const char header[] =
    "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
    "acceleration,force_command,position_command,faults,force_simulated";

static bool start(void) {
    return jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits);
}

static void next_contact(void) {
    jaxhil_next_contact(&controller);
}

/* Pass one row to the controller; return 0 if the results equal those of the row. */
static int replay(const char *name, long number, const double *row, const int *given) {
    const double force =
        jaxhil_step(&controller, row[FORCE_MEASURED], row[POSITION_DESIRED], row[VELOCITY_DESIRED],
                    row[POSITION_MEASURED], given[TIME] ? &row[TIME] : NULL);
    const double position =
        jaxhil_position_command(&controller, row[POSITION], row[VELOCITY], row[ACCELERATION]);
    const double faults = (double)controller.faults;
    if (!is_same(force, row[FORCE_COMMAND])) {
        return differs(name, number, "force_command", force, row[FORCE_COMMAND]);
    }
    if (!is_same(position, row[POSITION_COMMAND])) {
        return differs(name, number, "position_command", position, row[POSITION_COMMAND]);
    }
    return is_same(faults, row[FAULTS]) ? 0 : differs(name, number, "faults", faults, row[FAULTS]);
}
