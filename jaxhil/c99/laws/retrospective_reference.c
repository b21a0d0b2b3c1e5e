/* The retrospective reference with one force-depth map: the force is as old as the given delay says. */
#include <stdbool.h>

#include "force_depth_map.c"
#include "one_delay.c"
#include "retrospective_law.c"

/* == Definitions == */
