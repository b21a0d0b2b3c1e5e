/* The discrete filters that the laws are built of, one sample per control period.
 *
 * Each evaluates its equation from left to right as written.
 */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>

/* == Declarations == */

/* Lead (1 + T_1 s)/(1 + T_2 s), T_1 = lead + lag, T_2 = lag, by Tustin's rule at period T:
 * y = ((2 T_2 - T) y_prev + (2 T_1 + T) u - (2 T_1 - T) u_prev) / (2 T_2 + T). Times in s. */
typedef struct {
    double of_output, of_input, of_previous, denominator;
    double input, output;
} jaxhil_lead_filter;

void jaxhil_lead_filter_init(jaxhil_lead_filter *filter, double lead, double lag, double period);
void jaxhil_lead_filter_reset(jaxhil_lead_filter *filter);
double jaxhil_lead_filter_step(jaxhil_lead_filter *filter, double value);

/* Filtered derivative s/(1 + T_v s) by Tustin's rule at period T:
 * w = ((2 T_v - T) w_prev + 2 (x - x_prev)) / (2 T_v + T). Position in m, velocity in m/s, times in s.
 * Its past is 0; `start` makes it a uniform motion that reaches `position` at the next step. Of a force as
 * well. */
typedef struct {
    double period, of_velocity, denominator;
    double position, velocity;
} jaxhil_velocity_filter;

void jaxhil_velocity_filter_init(jaxhil_velocity_filter *filter, double time_constant, double period);
void jaxhil_velocity_filter_start(jaxhil_velocity_filter *filter, double position, double velocity);
double jaxhil_velocity_filter_step(jaxhil_velocity_filter *filter, double position);

/* A position delayed by tau >= 0, linear between samples: r = tau/T, q = floor(r + 1e-9), f = r - q,
 * output (1 - f) x[n-q] + f x[n-q-1]. Its samples lie in an array of the caller's; `init` is false for a
 * delay that needs more than its `capacity`. `start` makes the past the uniform motion
 * position + j T velocity. */
typedef struct {
    size_t whole, size, head;
    double fraction, remainder, period;
} jaxhil_delay_line;

bool jaxhil_delay_line_init(jaxhil_delay_line *line, double *samples, size_t capacity, double delay,
                            double period);
void jaxhil_delay_line_start(jaxhil_delay_line *line, double *samples, double position, double velocity);
double jaxhil_delay_line_step(jaxhil_delay_line *line, double *samples, double position);

/* == Definitions == */

void jaxhil_lead_filter_init(jaxhil_lead_filter *filter, double lead, double lag, double period) {
    const double zero = lead + lag;
    filter->of_output = 2.0 * lag - period;
    filter->of_input = 2.0 * zero + period;
    filter->of_previous = 2.0 * zero - period;
    filter->denominator = 2.0 * lag + period;
    jaxhil_lead_filter_reset(filter);
}

void jaxhil_lead_filter_reset(jaxhil_lead_filter *filter) {
    filter->input = 0.0;
    filter->output = 0.0;
}

double jaxhil_lead_filter_step(jaxhil_lead_filter *filter, double value) {
    const double output =
        (filter->of_output * filter->output + filter->of_input * value -
         filter->of_previous * filter->input) /
        filter->denominator;
    filter->input = value;
    filter->output = output;
    return output;
}

void jaxhil_velocity_filter_init(jaxhil_velocity_filter *filter, double time_constant, double period) {
    filter->period = period;
    filter->of_velocity = 2.0 * time_constant - period;
    filter->denominator = 2.0 * time_constant + period;
    filter->position = 0.0;
    filter->velocity = 0.0;
}

void jaxhil_velocity_filter_start(jaxhil_velocity_filter *filter, double position, double velocity) {
    filter->position = position - filter->period * velocity;
    filter->velocity = velocity;
}

double jaxhil_velocity_filter_step(jaxhil_velocity_filter *filter, double position) {
    const double velocity =
        (filter->of_velocity * filter->velocity + 2.0 * (position - filter->position)) / filter->denominator;
    filter->position = position;
    filter->velocity = velocity;
    return velocity;
}

bool jaxhil_delay_line_init(jaxhil_delay_line *line, double *samples, size_t capacity, double delay,
                            double period) {
    const double ratio = delay / period;
    /* Said so that a NaN is refused too, before any conversion to a whole number. */
    if (capacity < 2 || !(ratio >= 0.0 && floor(ratio + 1e-9) <= (double)(capacity - 2))) {
        return false;
    }
    /* The margin keeps a delay of a whole number of periods whole when its ratio rounds down. */
    line->whole = (size_t)floor(ratio + 1e-9);
    line->fraction = ratio - (double)line->whole;
    line->remainder = 1.0 - line->fraction;
    line->period = period;
    line->size = line->whole + 2;
    for (size_t j = 0; j < line->size; j++) {
        samples[j] = 0.0;
    }
    line->head = 0;
    return true;
}

void jaxhil_delay_line_start(jaxhil_delay_line *line, double *samples, double position, double velocity) {
    for (size_t j = 1; j < line->size; j++) {
        samples[j] = position + ((double)j - (double)line->size) * line->period * velocity;
    }
    line->head = 0;
}

double jaxhil_delay_line_step(jaxhil_delay_line *line, double *samples, double position) {
    const size_t head = line->head;
    const size_t newer = head >= line->whole ? head - line->whole : head + line->size - line->whole;
    const size_t older = newer > 0 ? newer - 1 : line->size - 1;
    samples[head] = position;
    line->head = head + 1 == line->size ? 0 : head + 1;
    return line->remainder * samples[newer] + line->fraction * samples[older];
}
