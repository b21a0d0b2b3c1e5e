/* Calls functions of an FMU of FMI 3.0 in random order with random arguments, argv[1] times, and lists how many
 * of them succeeded. With argv[2], instantiates, steps and frees argv[2] times, and prints the growth of the
 * process's memory [kB].
 *
 * Sanitizers stop the program at undefined behaviour, at access to memory that is not allocated, and at leaks.
 */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>

#include "fmi3Functions.h"
#include "fmu_variables.h"

enum { INSTANCES = 3, STATES = 4, MAX_VALUES = 8 };

static uint64_t random_state = 88172645463325252u;

static uint64_t draw(uint64_t below) {
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return random_state % below;
}

static double draw_value(void) {
    static const double odd[] = {0.0, -0.0, NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e-320, 1.0, -1.0};
    if (draw(3) == 0) {
        return odd[draw(sizeof odd / sizeof *odd)];
    }
    return ((double)draw(2000001) - 1e6) * pow(10.0, (double)draw(12) - 10.0);
}

static fmi3Instance new_instance(bool good) {
    return fmi3InstantiateCoSimulation("random", good ? FMU_TOKEN : "another", NULL, false, false, false, false,
                                       NULL, 0, NULL, NULL, NULL);
}

static fmi3Status do_step(fmi3Instance instance, double time, double step) {
    bool event, terminate, early;
    double reached;
    return fmi3DoStep(instance, time, step, true, &event, &terminate, &early, &reached);
}

static fmi3Status begin(fmi3Instance instance) {
    const fmi3Status status = fmi3EnterInitializationMode(instance, false, 0.0, 0.0, false, 0.0);
    return status == fmi3OK ? fmi3ExitInitializationMode(instance) : status;
}

static fmi3Status values(fmi3Instance instance) {
    uint32_t references[MAX_VALUES];
    double reals[MAX_VALUES];
    int32_t integers[MAX_VALUES];
    bool booleans[MAX_VALUES];
    static const char *const paths[] = {"", "x", "session.txt", "no/such/folder/session.csv", NULL};
    const char *texts[MAX_VALUES];
    const size_t count = draw(MAX_VALUES + 1), kind = draw(20) == 0 ? 6 + draw(2) : draw(6);
    for (size_t n = 0; n < count; n++) {
        do {
            references[n] = (uint32_t)draw(draw(100) == 0 ? 4000000000u : V_COUNT);
        } while (references[n] < V_COUNT && draw(50) != 0 &&
                 fmu_variables[references[n]].type != (kind < 6 ? (fmu_type)(kind % 3) : FMU_STRING));
        texts[n] = paths[draw(sizeof paths / sizeof *paths)];
        reals[n] = draw_value();
        integers[n] = (int32_t)draw(3);
        booleans[n] = draw(8) == 0;
    }
    switch (kind) {
    case 0:
        return fmi3SetFloat64(instance, references, count, reals, draw(50) == 0 ? count + 1 : count);
    case 1:
        return fmi3SetInt32(instance, references, count, integers, count);
    case 2:
        return fmi3SetBoolean(instance, references, count, booleans, count);
    case 3:
        return fmi3GetFloat64(instance, references, count, reals, count);
    case 4:
        return fmi3GetInt32(instance, references, count, integers, count);
    case 5:
        return fmi3GetBoolean(instance, references, count, booleans, count);
    case 6:
        return fmi3SetString(instance, references, count, texts, count);
    default:
        return fmi3GetString(instance, references, count, texts, count);
    }
}

static fmi3Status restored(fmi3Instance instance, fmi3FMUState *states) {
    fmi3Status status;
    size_t size = 0;
    uint8_t *bytes;
    fmi3FMUState *const from = &states[draw(STATES)], *const to = &states[draw(STATES)];
    if (fmi3SerializedFMUStateSize(instance, *from, &size) != fmi3OK) {
        return fmi3Error;
    }
    bytes = (uint8_t *)malloc(size);
    status = fmi3SerializeFMUState(instance, *from, bytes, size);
    if (draw(2) == 0) {
        bytes[draw(size)] ^= (uint8_t)(1u << draw(8)); /* the checksum refuses this state */
        if (fmi3DeserializeFMUState(instance, bytes, size, to) == fmi3OK) {
            printf("a damaged state was accepted\n");
            exit(1);
        }
    } else if (status == fmi3OK) {
        status = fmi3DeserializeFMUState(instance, bytes, draw(20) == 0 ? size - 1 : size, to);
    }
    free(bytes);
    return status;
}

static fmi3Status call(fmi3Instance *instances, fmi3FMUState *states) {
    const size_t number = draw(INSTANCES);
    fmi3Instance instance = instances[number];
    fmi3FMUState *const state = &states[draw(STATES)];
    switch (draw(40)) {
    case 0:
        fmi3FreeInstance(instance);
        instances[number] = new_instance(draw(4) != 0);
        return fmi3OK;
    case 1:
        return fmi3Reset(instance);
    case 2:
        return fmi3EnterInitializationMode(instance, false, 0.0, draw_value(), false, 0.0);
    case 3:
        return fmi3ExitInitializationMode(instance);
    case 4:
        return draw(10) == 0 ? fmi3Terminate(instance) : begin(instance);
    case 5:
        return fmi3GetFMUState(instance, state);
    case 6:
        return fmi3SetFMUState(instance, *state);
    case 7:
        return fmi3FreeFMUState(instance, state);
    case 8:
        return restored(instance, states);
    case 9:
        return do_step(instance, draw_value(), draw_value());
    case 10:
        return fmi3EnterEventMode(instance);
    default:
        return draw(2) == 0 ? values(instance) : do_step(instance, 0.001 * (double)draw(1000), FMU_PERIOD);
    }
}

static int call_randomly(long count) {
    fmi3Instance instances[INSTANCES];
    fmi3FMUState states[STATES] = {NULL};
    long succeeded = 0;
    for (size_t n = 0; n < INSTANCES; n++) {
        instances[n] = new_instance(true);
        begin(instances[n]);
    }
    for (long n = 0; n < count; n++) {
        succeeded += call(instances, states) == fmi3OK;
    }
    instances[0] = instances[0] != NULL ? instances[0] : new_instance(true);
    for (size_t n = 0; n < STATES; n++) {
        fmi3FreeFMUState(instances[0], &states[n]);
    }
    for (size_t n = 0; n < INSTANCES; n++) {
        fmi3FreeInstance(instances[n]);
    }
    printf("%ld of %ld calls succeeded\n", succeeded, count);
    return 0;
}

static long used_memory(void) {
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_maxrss;
}

static int instantiate_often(long count) {
    long before = 0;
    for (long n = 0; n < count; n++) {
        fmi3Instance instance = new_instance(true);
        if (instance == NULL || begin(instance) != fmi3OK || do_step(instance, 0.0, FMU_PERIOD) != fmi3OK) {
            return 1;
        }
        fmi3FreeInstance(instance);
        before = n == count / 100 ? used_memory() : before;
    }
    printf("%ld\n", used_memory() - before);
    return 0;
}

int main(int count, char **arguments) {
    return count == 2 ? call_randomly(atol(arguments[1])) : instantiate_often(atol(arguments[2]));
}
