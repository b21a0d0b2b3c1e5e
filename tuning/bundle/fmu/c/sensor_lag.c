/* See sensor_lag.h. Cubic polynomials interpolate the motion, and parabolas the force. */
#include "sensor_lag.h"

#include <math.h>

enum { FORCE_PARABOLAS = 2, FORCE_NODES = 2 * FORCE_PARABOLAS + 1, MAX_ROOT_STEPS = 50 };
static const double root_tolerance = 1e-13;         /* largest error of a root, in segments */
static const double min_closed_form_duration = 1e-2; /* shortest accurate parabola, in time constants */

/* Contact in a segment, as a function of the elapsed share s of the segment. */
typedef struct {
    double start, rate, bend, twist, duration; /* cubic Hermite polynomial of the position */
    double side, surface;                      /* the surface that is reached, and its direction */
    double turn, before, bottom;               /* reversal of the motion, and deepest penetrations */
    const contact_law *law;
} segment;

typedef double (*segment_function)(const segment *self, double s);

static double larger(double value, double other) {
    return value > other ? value : other;
}

static double position_at(const segment *self, double s) {
    return self->start + s * (self->rate + s * (self->bend + s * self->twist));
}

static double velocity_at(const segment *self, double s) {
    return (self->rate + s * (2.0 * self->bend + s * 3.0 * self->twist)) / self->duration;
}

static double depth_at(const segment *self, double s) {
    return self->side * (position_at(self, s) - self->surface);
}

static double inward_at(const segment *self, double s) {
    return self->side * velocity_at(self, s);
}

static contact_law law_at(const segment *self, double s) {
    contact_law law = *self->law;
    if (contact_law_has_memory()) {
        law.deepest = s > self->turn ? self->bottom : larger(self->before, depth_at(self, s));
    }
    return law;
}

static double separation_function_at(const segment *self, double s) {
    const contact_law law = law_at(self, s);
    return contact_law_separation_function(&law, depth_at(self, s), inward_at(self, s));
}

static double force_at(const segment *self, double s, bool at_surface) {
    const double rate = inward_at(self, s), depth = depth_at(self, s);
    const contact_law law = law_at(self, s);
    if (at_surface) {
        return contact_law_onset_force(self->law, rate);
    }
    return depth > 0.0 ? contact_law_force(&law, depth, rate) : 0.0;
}

/* Root of a function in [0, 1] by the Illinois variant of the false-position method; the values at 0 and 1 have
 * opposite signs. */
static double root_of(segment_function function, const segment *self, double at_0, double at_1) {
    double low = 0.0, high = 1.0, s = 1.0;
    int last_side = 0;
    for (int step = 0; step < MAX_ROOT_STEPS; step++) {
        const double before = s;
        double value;
        s = low + (high - low) * at_0 / (at_0 - at_1);
        value = function(self, s);
        if (value == 0.0 || fabs(s - before) < root_tolerance) {
            break;
        }
        if ((value > 0.0) == (at_1 > 0.0)) {
            high = s;
            at_1 = value;
            at_0 = last_side == 1 ? at_0 / 2.0 : at_0;
            last_side = 1;
        } else {
            low = s;
            at_0 = value;
            at_1 = last_side == -1 ? at_1 / 2.0 : at_1;
            last_side = -1;
        }
    }
    return s;
}

/* Interval in [0, 1] where a function with at most one root is positive. */
static void positive_interval(segment_function function, const segment *self, double *first, double *last) {
    const double at_0 = function(self, 0.0), at_1 = function(self, 1.0);
    *first = at_0 > 0.0 ? 0.0 : 1.0;
    *last = at_1 > 0.0 ? 1.0 : 0.0;
    if (at_0 > 0.0 && !(at_1 > 0.0)) {
        *last = root_of(function, self, at_0, at_1);
    } else if (at_1 > 0.0 && !(at_0 > 0.0)) {
        *first = root_of(function, self, at_0, at_1);
    }
}

/* Return whether the segment penetrates a surface; initialise `self`. */
static bool reaches_surface(segment *self, const contact_law *law, motion_state start, motion_state end,
                            double duration) {
    const double last = end.velocity * duration, moved = end.position - start.position;
    const double ends[2] = {start.position, end.position};
    double at_0, at_1;
    self->side = self->surface = 0.0;
    for (int n = 0; n < 2 && self->side == 0.0; n++) {
        if (ends[n] > 0.0) {
            self->side = 1.0;
        } else if (ends[n] < -RIG_CLEARANCE) {
            self->side = -1.0;
            self->surface = -RIG_CLEARANCE;
        }
    }
    self->law = law;
    self->duration = duration;
    self->start = start.position;
    self->rate = start.velocity * duration;
    self->bend = 3.0 * moved - 2.0 * self->rate - last;
    self->twist = self->rate + last - 2.0 * moved;
    if (self->side == 0.0) {
        return false;
    }
    at_0 = inward_at(self, 0.0);
    at_1 = inward_at(self, 1.0);
    self->turn = at_0 > 0.0 && 0.0 > at_1 ? root_of(inward_at, self, at_0, at_1) : 1.0;
    return true;
}

/* Coefficients of the lag's response to a parabola that lasts `span` time constants: decay of the initial value,
 * mean decay, and response at the end to the input 4 (t/span) (1 - t/span). */
static void parabola_weights(double span, double *decay, double *mean, double *response) {
    *decay = exp(-span);
    *mean = span > 0.0 ? -expm1(-span) / span : 1.0;
    *response = span < min_closed_form_duration
                    ? 4.0 * span * (1.0 / 6.0 - span * (1.0 / 12.0 - span * (1.0 / 40.0 - span / 180.0)))
                    : 4.0 * (*mean - 2.0 * (*mean - *decay) / span);
}

double apply_sensor_lag(double reading, const contact_law *law, motion_state start, motion_state end,
                        double duration, double deepest) {
    segment self;
    double enters, leaves, starts, ends, first, last, span, decay, mean, response, forces[FORCE_NODES];
    if (duration <= 0.0) {
        return reading;
    }
    if (!reaches_surface(&self, law, start, end, duration)) {
        return reading * exp(-duration / RIG_TIME_CONSTANT);
    }
    self.before = larger(deepest, depth_at(&self, 0.0));
    self.bottom = larger(self.before, contact_law_has_memory() ? depth_at(&self, self.turn) : 0.0);
    self.turn = contact_law_has_memory() ? self.turn : 1.0;
    positive_interval(depth_at, &self, &enters, &leaves);
    positive_interval(separation_function_at, &self, &starts, &ends);
    first = larger(enters, starts);
    last = leaves < ends ? leaves : ends;
    if (!(first < last)) {
        return reading * exp(-duration / RIG_TIME_CONSTANT);
    }
    for (int n = 0; n < FORCE_NODES; n++) {
        const double s = first + (last - first) * (n / (2.0 * FORCE_PARABOLAS));
        const bool at_surface = (n == 0 && enters > 0.0 && enters >= starts) ||
                                (n == FORCE_NODES - 1 && leaves < 1.0 && leaves <= ends);
        forces[n] = self.side * force_at(&self, s, at_surface);
    }
    reading *= exp(-first * duration / RIG_TIME_CONSTANT);
    span = (last - first) * duration / FORCE_PARABOLAS / RIG_TIME_CONSTANT;
    parabola_weights(span, &decay, &mean, &response);
    for (int n = 0; n < 2 * FORCE_PARABOLAS; n += 2) {
        const double begin = forces[n], finish = forces[n + 2];
        reading = reading * decay + finish - begin * decay - (finish - begin) * mean;
        reading += (forces[n + 1] - (begin + finish) / 2.0) * response;
    }
    return reading * exp(-(1.0 - last) * duration / RIG_TIME_CONSTANT);
}

double deepest_penetration(const contact_law *law, motion_state start, motion_state end, double duration) {
    segment self;
    if (!reaches_surface(&self, law, start, end, duration)) {
        return 0.0;
    }
    return larger(larger(depth_at(&self, 0.0), depth_at(&self, 1.0)), larger(depth_at(&self, self.turn), 0.0));
}
