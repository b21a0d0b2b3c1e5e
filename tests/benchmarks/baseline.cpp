// The contact loop of jaxhil written by hand: what plain C++ makes of the same physics.
//
// Kelvin-Voigt contact without tension, a motion simulator of order 2, linear hold, latency 0, semi-implicit
// Euler, ideal sensors with fractional delays, one surface, successive contacts as fresh runs; compensators none,
// phase lead, response error. The discretised simulator and the delays are input: jaxhil.simulation.loop.build_rig makes them.
//
// Lanes (scenarios) run in blocks of LANES, tick by tick; each variable of a block is an array over its lanes, so
// that the compiler turns the loops over lanes into vector instructions. Blocks are dealt out to the threads in turn.
// Delay lines begin a run filled with uniform motion: no reading asks whether it precedes the run. With SKIPS an
// approach is skipped until shortly before the mechanism touches.

#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>
#include <thread>
#include <vector>

#include <xmmintrin.h>

#ifndef LANES
#define LANES 16
#endif
#ifndef SKIPS
#define SKIPS 1
#endif

namespace {

constexpr int W = LANES;
constexpr int JUDGED_EVERY = 16;         // ticks between looks for time-outs and divergence
constexpr double APPROACH = 0.02;        // s of free approach before a contact
constexpr double MAX_CONTACT = 10;   // s
constexpr double RUNAWAY = 1e3;          // of the first approach speed
constexpr double FADED = 1e-6;           // of the command's peak
constexpr double LONG_QUIET = 1e6;       // ticks without a touch, before the first one
// Ticks without a touch after which a lane that has no contact left is over: it flies on.
constexpr double NEVER = std::numeric_limits<double>::infinity();
constexpr unsigned FLUSH_DENORMALS = 0x8040;

enum Status { NOT_REACHED = -1, OK = 0, TIMEOUT = 1, DIVERGED = 2, NON_FINITE = 3 };
enum Kind { NONE, PHASE_LEAD, RESPONSE_ERROR };
enum Gain {
    LEAD, LEAD_FILTER, RESPONSE, RESPONSE_DAMPING, INITIAL_STIFFNESS, INITIAL_DAMPING, STIFFNESS_COVARIANCE,
    DAMPING_COVARIANCE, FORGETTING, THRESHOLD, IDENTIFICATION_DELAY, VELOCITY_FILTER, GAINS
};

using Lanes = double[W];

}  // namespace

// Arrays are C-contiguous with lanes last; shapes in brackets. SI units. Mirrored in baseline.py.
struct Problem {
    int64_t lanes, slots, ring, kind, threads;
    const double *period, *mass, *velocity;                           // [lanes]
    const double *phase, *stiffness, *damping;                        // [slots, lanes]
    const double *transition;                                         // [2, 4, lanes]
    const double *position_row, *velocity_row, *measured_row;         // [4, lanes]
    const double *steady_command, *steady_velocity;                   // [2, lanes]
    const double *quiet, *patience;                                   // [lanes], ticks
    const double *gains;                                              // [GAINS, lanes]
    const int32_t *contacts, *force_intervals, *real_intervals, *position_intervals;  // [lanes]
    double *restitution, *approach_velocity, *peak_force, *peak_command, *duration;  // [slots, lanes]
    int32_t *status, *ticks;                                          // [slots, lanes]
};

namespace {

// A delay line for W lanes with a power of two of samples. Each is stored twice, one ring apart: a read of up to one
// ring back never wraps, and each lane reads at a fixed distance from a common pointer.
class DelayLine {
public:
    explicit DelayLine(int64_t ring) : ring_(ring), storage_(2 * ring * W + 8) {
        auto address = reinterpret_cast<uintptr_t>(storage_.data());
        data_ = storage_.data() + (64 - address % 64) % 64 / sizeof(double);
    }
    const double* newest(int64_t tick) const { return data_ + ((tick & (ring_ - 1)) + ring_) * W; }
    void write(int64_t tick, const Lanes& values) {
        double* __restrict row = data_ + (tick & (ring_ - 1)) * W;
        double* __restrict twin = row + ring_ * W;
        for (int l = 0; l < W; ++l) {
            row[l] = values[l];
            twin[l] = values[l];
        }
    }
    // The ring of one lane as if `last` had been written at `tick`, growing by `step` per tick.
    void fill(int lane, int64_t tick, double last, double step) {
        for (int64_t back = 0; back < ring_; ++back) {
            int64_t row = (tick - back) & (ring_ - 1);
            data_[row * W + lane] = data_[(row + ring_) * W + lane] = last - double(back) * step;
        }
    }

private:
    int64_t ring_;
    std::vector<double> storage_;
    double* data_;
};

struct alignas(64) Block {
    // Constants of the lanes.
    Lanes period, inverse_mass, quiet_rule, patience;
    Lanes transition[2][4], position_row[4], velocity_row[4], measured_row[4], steady_command[2], steady_velocity[2];
    Lanes stiffness, damping;  // of the contact under way
    Lanes lead_keep, lead_now, lead_before;
    Lanes response, response_damping, stiffness_covariance, damping_covariance, forgetting;
    Lanes threshold, fraction, rate_keep, rate_gain;
    int64_t force_back[W], real_back[W], position_back[W], aligned_back[W];

    // Numerical model and motion simulator.
    Lanes position, velocity, command, plant[2];
    // Compensators.
    Lanes lead_force, lead_output;
    Lanes measured, measured_rate, aligned, aligned_rate, older, contact_share, force_share;
    Lanes identified_stiffness, identified_damping, coupling, stiffness_variance, damping_variance;
    // The contact under way.
    Lanes elapsed, approach, peak_force, peak_command, before, middle, touched, quiet;

    int64_t begun_at[W];
    int32_t index[W];
    bool active[W];
};

// Share of a period that a reading, straight between two ticks, spends beyond a threshold.
// Without a branch: a division that only some lanes make would keep the compiler from doing several lanes at a time.
inline double share_beyond(double now, double before, double threshold) {
    const double beyond = now > threshold, crossed = beyond != (before > threshold);
    const double inside = beyond * now + (1 - beyond) * before - threshold;
    return crossed * inside / (std::fabs(now - before) + (1 - crossed)) + (1 - crossed) * beyond;
}

// The time beyond, weighed with a triangle two periods wide, from its shares of the last two periods.
inline double gate(double s, double l) { return (s * s + l * l) / 2 + s * l * (2 - s - l); }

double dot(const Lanes (&row)[4], int l, double z_0, double z_1, double start, double end) {
    return row[0][l] * z_0 + row[1][l] * z_1 + row[2][l] * start + row[3][l] * end;
}

template <Kind kind>
class Runner {
public:
    explicit Runner(const Problem& problem)
        : p(problem), force_line(p.ring), position_line(p.ring), aligned_line(p.ring) {}

    // Block number `block` for `ticks` ticks; without `contacts` only the first contact, which is never turned over.
    template <bool contacts>
    void run(int64_t block, int64_t ticks) {
        first = block * W;
        load();
        for (int l = 0; l < W; ++l) approach(l, p.velocity[number(l)], 0);
        for (int64_t tick = 0; tick < ticks; ++tick) {
            const bool some_over = step(tick);
            if (some_over) turn_over<contacts>(tick);
            if (contacts && tick % JUDGED_EVERY == JUDGED_EVERY - 1) judge(tick);
        }
    }

private:
    const Problem& p;
    Block b;
    int64_t first;  // lane of the block
    DelayLine force_line, position_line, aligned_line;
    double over[W];  // speed [m/s] of a contact that is over, -1 for the others

    // Lanes beyond the last one repeat it.
    int64_t number(int l) const { return first + l < p.lanes ? first + l : p.lanes - 1; }

    void load() {
        for (int l = 0; l < W; ++l) {
            const int64_t n = number(l);
            auto row = [&](const double* table, int64_t i) { return table[i * p.lanes + n]; };
            auto gain = [&](Gain g) { return row(p.gains, g); };
            const double period = b.period[l] = p.period[n];
            b.inverse_mass[l] = 1 / p.mass[n];
            b.patience[l] = p.patience[n];
            for (int i = 0; i < 4; ++i) {
                b.transition[0][i][l] = row(p.transition, i);
                b.transition[1][i][l] = row(p.transition, 4 + i);
                b.position_row[i][l] = row(p.position_row, i);
                b.velocity_row[i][l] = row(p.velocity_row, i);
                b.measured_row[i][l] = row(p.measured_row, i);
            }
            for (int i = 0; i < 2; ++i) {
                b.steady_command[i][l] = row(p.steady_command, i);
                b.steady_velocity[i][l] = row(p.steady_velocity, i);
            }
            const double slow = 2 * gain(LEAD_FILTER), fast = slow + 2 * gain(LEAD);
            b.lead_keep[l] = (slow - period) / (slow + period);
            b.lead_now[l] = (fast + period) / (slow + period);
            b.lead_before[l] = (fast - period) / (slow + period);
            const double smoothing = 2 * gain(VELOCITY_FILTER);
            b.rate_keep[l] = (smoothing - period) / (smoothing + period);
            b.rate_gain[l] = 2 / (smoothing + period);
            b.response[l] = gain(RESPONSE);
            b.response_damping[l] = gain(RESPONSE_DAMPING);
            b.identified_stiffness[l] = gain(INITIAL_STIFFNESS);
            b.identified_damping[l] = gain(INITIAL_DAMPING);
            b.stiffness_covariance[l] = gain(STIFFNESS_COVARIANCE);
            b.damping_covariance[l] = gain(DAMPING_COVARIANCE);
            b.forgetting[l] = gain(FORGETTING);
            b.threshold[l] = gain(THRESHOLD);
            const double periods = gain(IDENTIFICATION_DELAY) / period, whole = std::floor(periods + 1e-9);
            b.fraction[l] = periods - whole;
            b.force_back[l] = l - int64_t(p.force_intervals[n]) * W;
            b.real_back[l] = l - int64_t(p.real_intervals[n]) * W;
            b.position_back[l] = l - int64_t(p.position_intervals[n]) * W;
            b.aligned_back[l] = l - int64_t(whole) * W;
            b.index[l] = 0;
            b.active[l] = first + l < p.lanes && p.contacts[n] > 0;
        }
    }

    // Component i of the motion simulator's state in uniform motion.
    double steady(int i, int l, double command, double stride) const {
        return b.steady_command[i][l] * command + b.steady_velocity[i][l] * stride;
    }

    // The run of lane l that begins at `tick`, on the contact b.index[l], at speed `velocity`.
    void approach(int l, double velocity, int64_t tick) {
        const int64_t n = number(l), entry = (b.index[l] < p.slots ? b.index[l] : p.slots - 1) * p.lanes + n;
        const double period = b.period[l], stride = period * velocity;
        const double from = -velocity * (APPROACH + p.phase[entry] * period);
        // Nothing happens until two periods before the mechanism touches: the flight until then is skipped.
        const double sample = dot(b.position_row, l, steady(0, l, from - stride, stride),
                                  steady(1, l, from - stride, stride), from - stride, from);
        const double periods = SKIPS && stride > 0 ? std::floor(-sample / stride) - 2 : 0;
        const double position = from + (periods > 0 ? periods : 0) * stride, start = position - stride;
        b.stiffness[l] = p.stiffness[entry];
        b.damping[l] = p.damping[entry];
        b.position[l] = b.command[l] = position;
        b.velocity[l] = velocity;
        double past[2];
        for (int i = 0; i < 2; ++i) {
            past[i] = steady(i, l, start, stride);
            b.plant[i][l] = steady(i, l, position, stride);
        }
        const double first_position = dot(b.measured_row, l, past[0], past[1], start, position);
        force_line.fill(l, tick - 1, 0, 0);
        position_line.fill(l, tick - 1, first_position, stride);

        b.lead_force[l] = b.lead_output[l] = 0;
        if (kind == RESPONSE_ERROR) {
            const double measured = first_position - double(p.position_intervals[n]) * stride;
            const double delay = p.gains[IDENTIFICATION_DELAY * p.lanes + n] / period;
            b.measured[l] = measured - stride;
            b.aligned[l] = measured - delay * stride - stride;
            b.measured_rate[l] = b.aligned_rate[l] = velocity;
            aligned_line.fill(l, tick - 1, measured - stride, stride);
            b.older[l] = measured - (std::floor(delay + 1e-9) + 1) * stride;
            b.contact_share[l] = b.force_share[l] = 0;
            b.coupling[l] = 0;
            b.stiffness_variance[l] = b.stiffness_covariance[l];
            b.damping_variance[l] = b.damping_covariance[l];
        }
        b.quiet_rule[l] = b.active[l] ? p.quiet[n] : NEVER;
        b.elapsed[l] = b.approach[l] = b.peak_force[l] = b.peak_command[l] = 0;
        b.before[l] = b.middle[l] = b.touched[l] = 0;
        b.quiet[l] = LONG_QUIET;
        b.begun_at[l] = tick;
    }

    // One tick of all lanes; whether a contact is over on any of them.
    bool step(int64_t tick) {
        alignas(64) Lanes force, real, measured, newer, contact, reading;
        const double *forces = force_line.newest(tick - 1), *positions = position_line.newest(tick - 1);
        for (int l = 0; l < W; ++l) {
            force[l] = forces[b.force_back[l]];
            real[l] = forces[b.real_back[l]];
            measured[l] = positions[b.position_back[l]];
        }
        if (kind == RESPONSE_ERROR) {
            aligned_line.write(tick, measured);
            const double* readings = aligned_line.newest(tick);
            for (int l = 0; l < W; ++l) newer[l] = readings[b.aligned_back[l]];
        }
        int64_t any = 0;
        for (int l = 0; l < W; ++l) {
            const double x = b.position[l], v = b.velocity[l];
            const double force_before = b.lead_force[l];
            double command = force[l];
            if (kind != NONE) {
                command = b.lead_keep[l] * b.lead_output[l] + b.lead_now[l] * force[l]
                          - b.lead_before[l] * b.lead_force[l];
                b.lead_force[l] = force[l];
                b.lead_output[l] = command;
            }
            if (kind == RESPONSE_ERROR)
                command = respond(l, command, force[l], force_before, measured[l], newer[l], x, v);

            // The contact under way: begin, end, peaks.
            const double magnitude = std::fabs(command), speed = std::fabs(v), truth = real[l];
            const double elapsed = b.elapsed[l], approached = b.approach[l], touched = b.touched[l];
            const double peak_force = b.peak_force[l], peak_command = b.peak_command[l], calm = b.quiet[l] + 1;
            const bool touching = truth > 0, begun = (elapsed > 0) | touching | (magnitude > 0);
            const double peak = magnitude > peak_command ? magnitude : peak_command;
            const double quiet = touching ? 0 : calm;
            const bool is_over = begun & (v < 0) & (quiet >= b.quiet_rule[l])
                                 & ((magnitude <= FADED * peak) | (quiet >= b.patience[l]));
            const double before = b.before[l], middle = b.middle[l], bend = 2 * middle - before - truth;
            const bool crests = (middle >= before) & (middle >= truth) & (bend > 0) & (before > 0) & (truth > 0);
            const double rise = truth - before, vertex = middle + rise * rise / (8 * (crests ? bend : 1));
            const double crest = crests ? vertex : truth;
            b.elapsed[l] = begun ? elapsed + 1 : elapsed;
            b.approach[l] = begun ? approached : speed;
            b.peak_force[l] = crest > peak_force ? crest : peak_force;
            b.peak_command[l] = peak;
            b.before[l] = middle;
            b.middle[l] = truth;
            b.touched[l] = touching ? touched + 1 : touched;
            b.quiet[l] = quiet;
            over[l] = is_over ? speed : -1;
            any |= is_over ? int64_t(1) : int64_t(0);

            // Numerical model, motion simulator, mechanism.
            const double new_v = v - b.period[l] * (command * b.inverse_mass[l]);
            const double end = x + b.period[l] * new_v, start = b.command[l];
            const double z_0 = b.plant[0][l], z_1 = b.plant[1][l];
            const double depth = dot(b.position_row, l, z_0, z_1, start, end);
            const double rate = dot(b.velocity_row, l, z_0, z_1, start, end);
            const double push = b.stiffness[l] * depth + b.damping[l] * rate;
            contact[l] = (depth > 0) & (push > 0) ? push : 0;
            reading[l] = dot(b.measured_row, l, z_0, z_1, start, end);
            b.velocity[l] = new_v;
            b.position[l] = b.command[l] = end;
            b.plant[0][l] = dot(b.transition[0], l, z_0, z_1, start, end);
            b.plant[1][l] = dot(b.transition[1], l, z_0, z_1, start, end);
        }
        force_line.write(tick, contact);
        position_line.write(tick, reading);
        return any;
    }

    // Response error on the identified contact: F_c from the led force.
    inline __attribute__((always_inline)) double respond(
        int l, double led, double force, double force_before, double measured, double newer, double x, double v) {
        const double aligned = newer - b.fraction[l] * (newer - b.older[l]);
        const double rate = b.rate_keep[l] * b.measured_rate[l] + b.rate_gain[l] * (measured - b.measured[l]);
        const double aligned_rate
            = b.rate_keep[l] * b.aligned_rate[l] + b.rate_gain[l] * (aligned - b.aligned[l]);
        const double share = share_beyond(aligned, b.aligned[l], 0), open = gate(share, b.contact_share[l]);
        const double force_share = share_beyond(std::fabs(force), std::fabs(force_before), b.threshold[l]);
        const double weight = open * gate(force_share, b.force_share[l]);
        b.contact_share[l] = share;
        b.force_share[l] = force_share;
        b.older[l] = newer;
        b.measured[l] = measured;
        b.measured_rate[l] = rate;
        b.aligned[l] = aligned;
        b.aligned_rate[l] = aligned_rate;

        // Weighted recursive least squares on the factors of the covariance.
        const double depth = aligned > 0 ? aligned : 0, kept = 1 - weight * (1 - b.forgetting[l]);
        const double k = b.identified_stiffness[l], c = b.identified_damping[l], u = b.coupling[l];
        const double d_1 = b.stiffness_variance[l], d_2 = b.damping_variance[l];
        const double f_2 = u * depth + aligned_rate;
        const double g_1 = weight * d_1 * depth, g_2 = weight * d_2 * f_2;
        const double alpha_1 = kept + depth * g_1, alpha_2 = alpha_1 + f_2 * g_2;
        const double inverse_1 = 1 / alpha_1, inverse_2 = 1 / alpha_2;
        const double innovation = (force - (k * depth + c * aligned_rate)) * inverse_2;
        const double new_k = k + (g_1 + g_2 * u) * innovation, new_c = c + g_2 * innovation;
        b.identified_stiffness[l] = new_k;
        b.identified_damping[l] = new_c;
        b.coupling[l] = u - g_1 * f_2 * inverse_1;
        const double new_1 = d_1 * inverse_1, new_2 = d_2 * alpha_1 * inverse_2 / kept;
        const double most_1 = b.stiffness_covariance[l], most_2 = b.damping_covariance[l];
        b.stiffness_variance[l] = new_1 < most_1 ? new_1 : most_1;
        b.damping_variance[l] = new_2 < most_2 ? new_2 : most_2;
        const double response = b.response[l] * new_k * (x - measured) + b.response_damping[l] * new_c * (v - rate);
        return led + open * response;
    }

    // Enter the contacts that were over at `tick` into the results and begin the next ones.
    template <bool contacts>
    void turn_over(int64_t tick) {
        for (int l = 0; l < W; ++l) {
            if (over[l] < 0) continue;
            enter_result(l, OK, over[l], tick);
            b.active[l] = contacts && ++b.index[l] < p.contacts[number(l)];
            if (contacts) approach(l, over[l], tick + 1);
            if (!b.active[l]) b.quiet_rule[l] = NEVER;
        }
    }

    // Stop lanes that go on for ever or run away.
    void judge(int64_t tick) {
        for (int l = 0; l < W; ++l) {
            if (!b.active[l]) continue;
            const double limit = MAX_CONTACT / b.period[l], speed = std::fabs(b.velocity[l]);
            const bool waiting = b.elapsed[l] == 0 && double(tick + 1 - b.begun_at[l]) > limit;
            const int status = !std::isfinite(speed) ? NON_FINITE
                : speed > RUNAWAY * p.velocity[number(l)] ? DIVERGED
                : waiting || b.elapsed[l] > limit ? TIMEOUT : OK;
            if (status == OK) continue;
            enter_result(l, status, speed, tick);
            b.active[l] = false;
            approach(l, p.velocity[number(l)], tick + 1);
        }
    }

    void enter_result(int l, int status, double rebound, int64_t tick) {
        if (first + l >= p.lanes) return;
        const int64_t at = b.index[l] * p.lanes + first + l;
        p.restitution[at] = b.approach[l] > 0 ? rebound / b.approach[l] : std::nan("");
        p.approach_velocity[at] = b.approach[l];
        p.peak_force[at] = b.peak_force[l];
        p.peak_command[at] = b.peak_command[l];
        p.duration[at] = b.touched[l] * b.period[l];
        p.status[at] = status;
        p.ticks[at] = int32_t(tick + 1);
    }
};

template <Kind kind, bool contacts>
void work(const Problem& problem, int64_t thread, int64_t ticks) {
    _mm_setcsr(_mm_getcsr() | FLUSH_DENORMALS);
    const int64_t blocks = (problem.lanes + W - 1) / W;
    Runner<kind> runner(problem);
    for (int64_t block = thread; block < blocks; block += problem.threads) {
        runner.template run<contacts>(block, ticks);
    }
}

template <bool contacts>
double timed(const Problem& problem, int64_t ticks) {
    const auto begin = std::chrono::steady_clock::now();
    auto* function = problem.kind == NONE ? work<NONE, contacts>
        : problem.kind == PHASE_LEAD ? work<PHASE_LEAD, contacts> : work<RESPONSE_ERROR, contacts>;
    std::vector<std::thread> threads;
    for (int64_t thread = 1; thread < problem.threads; ++thread) {
        threads.emplace_back(function, std::cref(problem), thread, ticks);
    }
    const unsigned mode = _mm_getcsr();
    function(problem, 0, ticks);
    _mm_setcsr(mode);
    for (auto& thread : threads) thread.join();
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
}

}  // namespace

extern "C" {

// Every lane through `ticks` ticks of its first approach, contact and flight away; seconds.
double run_ticks(const Problem* problem, int64_t ticks) { return timed<false>(*problem, ticks); }

// Every lane through all its contacts, each begun when the last is over, and on to `horizon` ticks; seconds.
double run_contacts(const Problem* problem, int64_t horizon) { return timed<true>(*problem, horizon); }

int block_lanes() { return W; }
}
