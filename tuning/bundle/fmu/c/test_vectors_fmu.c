/* Number of values of each quantity, and index of the first column of each group of quantities. */
enum {
    WIDTH = @width@,
    EVENT = 1,
    READINGS = 2,
    TIME = READINGS + 4 * WIDTH,
    MOTION = TIME + 1,
    COMMANDS = MOTION + @motions@ * WIDTH,
    FAULTS = COMMANDS + 2 * WIDTH,
    COLUMNS = FAULTS + 1 + WIDTH
};

static const char header[] =
    "@header@";

static long ticks; /* number of steps since the start of the run */

#if FMI_VERSION == 3
static void report(fmi3InstanceEnvironment unused, fmi3Status status, fmi3String category, fmi3String message) {
    (void)unused, (void)status, (void)category;
    fprintf(stderr, "%s\n", message);
}

static bool start(void) {
    ticks = 0;
    if (controller == NULL) {
        controller = fmi3InstantiateCoSimulation("self-test", FMU_TOKEN, NULL, false, false, false, false, NULL, 0,
                                                 NULL, report, NULL);
    }
    return controller != NULL && fmi3Reset(controller) == fmi3OK &&
           fmi3EnterInitializationMode(controller, false, 0.0, 0.0, false, 0.0) == fmi3OK &&
           fmi3ExitInitializationMode(controller) == fmi3OK;
}

static bool set_reals(const uint32_t *references, const double *values, size_t count) {
    return fmi3SetFloat64(controller, references, count, values, count) == fmi3OK;
}

static bool set_boolean(uint32_t reference, bool value) {
    return fmi3SetBoolean(controller, &reference, 1, &value, 1) == fmi3OK;
}

static bool get_reals(const uint32_t *references, double *values, size_t count) {
    return fmi3GetFloat64(controller, references, count, values, count) == fmi3OK;
}

static bool get_faults(int32_t *faults) {
    const uint32_t reference = V_FAULTS;
    return fmi3GetInt32(controller, &reference, 1, faults, 1) == fmi3OK;
}

static bool do_step(void) {
    bool event, terminate, early;
    double reached;
    return fmi3DoStep(controller, (double)ticks++ * FMU_PERIOD, FMU_PERIOD, true, &event, &terminate, &early,
                      &reached) == fmi3OK;
}
#else
static void report(fmi2ComponentEnvironment unused, fmi2String name, fmi2Status status, fmi2String category,
                   fmi2String message, ...) {
    (void)unused, (void)name, (void)status, (void)category;
    fprintf(stderr, "error of the FMU: %s\n", message);
}

static bool start(void) {
    static const fmi2CallbackFunctions callbacks = {report, NULL, NULL, NULL, NULL};
    ticks = 0;
    if (controller == NULL) {
        controller = fmi2Instantiate("self-test", fmi2CoSimulation, FMU_TOKEN, "", &callbacks, fmi2False, fmi2False);
    }
    return controller != NULL && fmi2Reset(controller) == fmi2OK &&
           fmi2SetupExperiment(controller, fmi2False, 0.0, 0.0, fmi2False, 0.0) == fmi2OK &&
           fmi2EnterInitializationMode(controller) == fmi2OK && fmi2ExitInitializationMode(controller) == fmi2OK;
}

static bool set_reals(const uint32_t *references, const double *values, size_t count) {
    return fmi2SetReal(controller, references, count, values) == fmi2OK;
}

static bool set_boolean(uint32_t reference, bool value) {
    const fmi2Boolean given = value ? fmi2True : fmi2False;
    return fmi2SetBoolean(controller, &reference, 1, &given) == fmi2OK;
}

static bool get_reals(const uint32_t *references, double *values, size_t count) {
    return fmi2GetReal(controller, references, count, values) == fmi2OK;
}

static bool get_faults(int32_t *faults) {
    const uint32_t reference = V_FAULTS;
    return fmi2GetInteger(controller, &reference, 1, faults) == fmi2OK;
}

static bool do_step(void) {
    return fmi2DoStep(controller, (double)ticks++ * FMU_PERIOD, FMU_PERIOD, fmi2True) == fmi2OK;
}
#endif

static void next_contact(void) {} /* `replay` sets this input before every step */

/* Set real inputs or get real outputs; the value references of a group follow each other. */
static bool exchange(uint32_t first, const double *inputs, double *outputs, size_t count) {
    uint32_t references[4 * WIDTH];
    for (size_t n = 0; n < count; n++) {
        references[n] = first + (uint32_t)n;
    }
    return outputs == NULL ? set_reals(references, inputs, count) : get_reals(references, outputs, count);
}

static bool step(const double *row, const int *given, double *commands, int32_t *faults) {
    return exchange(@readings@, row + READINGS, NULL, TIME - READINGS) &&
           exchange(@motion@, row + MOTION, NULL, COMMANDS - MOTION) &&
           exchange(V_TICK_TIME, &row[TIME], NULL, 1) && set_boolean(V_HAS_TICK_TIME, given[TIME]) &&
           set_boolean(V_NEXT_CONTACT, row[EVENT] == 2.0) && do_step() &&
           exchange(@commands@, NULL, commands, FAULTS - COMMANDS) && get_faults(faults);
}

/* Pass one row to the FMU; return 0 if the results equal those of the row. */
static int replay(const char *name, long number, const double *row, const int *given) {
    double commands[FAULTS - COMMANDS];
    int32_t faults;
    if (!step(row, given, commands, &faults)) {
        return unreadable(name, number, "a function of the FMU returned an error");
    }
    for (int n = 0; n < FAULTS - COMMANDS; n++) {
        if (!is_same(commands[n], row[COMMANDS + n])) {
            return differs(name, number, n < WIDTH ? "@force@_command" : "@position@_command", commands[n],
                           row[COMMANDS + n]);
        }
    }
    return is_same((double)faults, row[FAULTS]) ? 0 : differs(name, number, "faults", (double)faults, row[FAULTS]);
}
