/* Answers of controller and numerical model to the readings of the plant. */
#ifndef RT_TASK_H
#define RT_TASK_H

#include "rt_loop.h"

/* Compute the commands for these readings; return false if they belong to no prepared run. Add the ticks to the
 * log. */
bool rt_answer(const readings *now, commands *answer);

/* Return whether there was no run yet, or the drives are at rest after a trip and no force acts on the model. */
bool rt_is_at_rest(void);

#endif
