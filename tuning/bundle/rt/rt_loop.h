/* Interface between the real-time loop (rt_loop.c) and the plant: sensors and drives. */
#ifndef RT_LOOP_H
#define RT_LOOP_H

#include <signal.h>
#include <stdbool.h>
#include <stdint.h>

@constants@

enum { PREPARE = 1, TICK = 2, STOP = 3, RESET = 4 };         /* events, as in udp_protocol.py */
enum { READY = 1, TRIPPED = 2, TARING = 4 };                 /* bits of `commands.flags` */

typedef struct {
    int event;             /* PREPARE: the drives wait for the run with this number; TICK: a run goes on */
    uint32_t run, tick;    /* number of the run, number of the tick in the run */
    double time;           /* of the tick, from a steady clock [s] */
    double force[AXES];    /* reading [N]; six axes: wrench on the chaser about T's origin, in T axes [N, N m] */
    double position[AXES]; /* reading [m]; six axes: pose of C relative to T [m, rad] */
    /* Model at tick 0. One axis: position [m] and velocity [m/s], or NaN for the default. Six axes: position
     * and velocity of the centre of mass, quaternion and angular momentum of target and chaser, in world axes. */
    double start[START_VALUES];
    double shift; /* added to the next deadline, to follow the clock of the plant [s]; or 0 */
} readings;

typedef struct {
    unsigned flags;
    double position[AXES], rate[AXES];        /* commands to the drives [m, rad], [m/s, rad/s] */
    double model_position[AXES], model_velocity[AXES]; /* of the model at this tick */
    double force[AXES];                       /* on the model [N, N m] */
    uint32_t faults, cause;                   /* bits of the faults: of the tick, of the trip */
} commands;

typedef struct {
    bool (*open)(void *plant);                          /* wait until the plant is ready; false: give up */
    bool (*read)(void *plant, readings *now);           /* false: no readings in this period */
    bool (*write)(void *plant, const commands *answer); /* false: the plant has not taken the commands */
    void (*close)(void *plant);                         /* called at rest, or if the plant is lost */
    void *plant;
} plant_io;

extern const plant_io rt_plant;                                 /* the plant of this program */
bool rt_plant_option(const char *name, const char *value);      /* whether this is an option of the plant */
extern volatile sig_atomic_t stop_requested;                    /* not 0 after SIGTERM or SIGINT */

#endif
