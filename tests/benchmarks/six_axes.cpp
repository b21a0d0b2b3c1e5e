// The six-axis contact loop of jaxhil written by hand: what plain C++ makes of the same physics.
//
// A sphere in a drogue, Hunt and Crossley's force, regularised friction; six second-order axes with delays of their
// own, linear hold, latency 0; semi-implicit Euler on both bodies; a sensor on the fixed side with a bias,
// without noise and lag; no compensator. The discretised axes, the delays and the first state are input:
// jaxhil.sixdof.loop makes them.
//
// Lanes run in blocks of W, each number of a block a vector of the processor. Angles are small: rotations are the
// series of jaxhil.sixdof.rotations near 0.

#include <chrono>
#include <cmath>
#include <cstdint>
#include <vector>

#ifndef LANES
#define LANES 8
#endif

namespace {

constexpr int W = LANES;
typedef double V __attribute__((vector_size(W * sizeof(double))));
typedef int64_t I __attribute__((vector_size(W * sizeof(int64_t))));

struct Vector { V x, y, z; };
struct Quaternion { V w; Vector v; };
struct Matrix { Vector x, y, z; };
struct Body { V mass; Matrix inertia, inverse; Vector interface; };
struct State { Vector r, v; Quaternion q; Vector spin; };
struct Load { Vector force, torque; };

inline V all(double x) { return V{} + x; }
inline V root(V a) {
    for (int l = 0; l < W; ++l) a[l] = std::sqrt(a[l]);
    return a;
}
inline Vector operator+(Vector a, Vector b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator-(Vector a, Vector b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector operator-(Vector a) { return {-a.x, -a.y, -a.z}; }
inline Vector operator*(V s, Vector a) { return {s * a.x, s * a.y, s * a.z}; }
inline V dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(Vector a, Vector b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vector operator*(const Matrix& m, Vector a) { return {dot(m.x, a), dot(m.y, a), dot(m.z, a)}; }
inline Quaternion compose(Quaternion a, Quaternion b) {
    return {a.w * b.w - dot(a.v, b.v), a.w * b.v + b.w * a.v + cross(a.v, b.v)};
}
inline Quaternion reverse(Quaternion q) { return {q.w, -q.v}; }
inline Vector rotate(Quaternion q, Vector a) {
    const Vector along = all(2) * cross(q.v, a);
    return a + q.w * along + cross(q.v, along);
}
inline Vector back(Quaternion q, Vector a) { return rotate(reverse(q), a); }

struct Series {
    double c[8];
    V operator()(V x) const {
        V total = all(c[7]);
        for (int k = 6; k >= 0; --k) total = total * x + c[k];
        return total;
    }
};
Series alternating(int first) {
    Series s;
    for (int k = 0; k < 8; ++k) s.c[k] = (k % 2 ? -1 : 1) / std::tgamma(2 * k + first + 1.0);
    return s;
}
const Series cosine = alternating(0), sine = alternating(1), versine = alternating(2), cubic = alternating(3);
const Series arctangent{{1, -1. / 3, 1. / 5, -1. / 7, 1. / 9, -1. / 11, 1. / 13, -1. / 15}};

inline Quaternion exponential(Vector theta) {
    const V square = 0.25 * dot(theta, theta);
    return {cosine(square), (0.5 * sine(square)) * theta};
}
inline Vector logarithm(Quaternion q) {
    const V w = q.w < 0 ? -q.w : q.w;
    const V share = 2 * arctangent(dot(q.v, q.v) / (w * w)) / w;
    return (q.w < 0 ? -share : share) * q.v;
}
inline Vector left_jacobian(Vector theta, Vector rate) {
    const V square = dot(theta, theta);
    const Vector once = cross(theta, rate);
    return rate + versine(square) * once + cubic(square) * cross(theta, once);
}

// The drogue: signed distance and normal.
struct Drogue { V sine, cosine, radius, bottom; };
inline V surface(const Drogue& d, Vector x, Vector& n) {
    const V rho = root(x.x * x.x + x.y * x.y + 1e-24), z = x.z - d.bottom;
    const V apart = root(x.x * x.x + x.y * x.y + z * z);
    const V share = -1 / apart;
    const I wall = rho * d.sine + z * d.cosine > 0;
    n = {wall ? -d.cosine * x.x / rho : share * x.x, wall ? -d.cosine * x.y / rho : share * x.y,
         wall ? d.sine : share * z};
    return wall ? d.radius - (rho * d.cosine - z * d.sine) : d.radius - apart;
}

inline void kick_drift(const Body& body, State& s, Load load, V period) {
    const Vector kick = (period / body.mass) * load.force;
    s.spin = s.spin + period * load.torque;
    auto turned = [&](Quaternion at, V duration) {
        return compose(s.q, exponential(duration * (body.inverse * back(at, s.spin))));
    };
    const Quaternion end = turned(turned(s.q, 0.5 * period), period);
    const V size = 1 / root(end.w * end.w + dot(end.v, end.v));
    s.v = s.v + kick;
    s.r = s.r + period * s.v;
    s.q = {size * end.w, size * end.v};
}

}  // namespace

// Arrays are C-contiguous with lanes last; shapes in brackets. Mirrored in six_axes_baseline.py.
struct Problem {
    int64_t lanes, ring;
    const double *period;            // [lanes]
    const double *bodies;            // [2, 22, lanes]: mass, inertia, its inverse, interface
    double *states;                  // [2, 13, lanes]: position, velocity, attitude, spin
    const double *transition;        // [2, 4, 6, lanes]
    const double *rows;              // [2, 4, 6, lanes]: position, velocity at the force sensor's place
    double *axes;                    // [2, 6, lanes]: state
    const double *samples;           // [ring, 2, 6, lanes]: position and rate of the intervals before the run
    const double *command;           // [6, lanes]: as sent
    const int64_t *intervals;        // [6, lanes]
    const double *contact;           // [10, lanes]: radius, drogue, stiffness, damping, friction, slip; sphere's centre
    const double *bias;              // [6, lanes]
};

namespace {

inline V load(const double* array, int64_t row, int64_t lanes, int64_t lane) {
    V v;
    for (int l = 0; l < W; ++l) v[l] = array[row * lanes + lane + l];
    return v;
}
inline void store(double* array, int64_t row, int64_t lanes, int64_t lane, V v) {
    for (int l = 0; l < W; ++l) array[row * lanes + lane + l] = v[l];
}

void block(const Problem& p, int64_t lane, int64_t ticks) {
    auto get = [&](const double* array, int64_t row) { return load(array, row, p.lanes, lane); };
    auto triple = [&](const double* a, int64_t row) { return Vector{get(a, row), get(a, row + 1), get(a, row + 2)}; };
    auto square = [&](const double* a, int64_t row) {
        return Matrix{triple(a, row), triple(a, row + 3), triple(a, row + 6)};
    };
    Body body[2];
    State s[2];
    for (int b = 0; b < 2; ++b) {
        const int64_t at = 22 * b, from = 13 * b;
        body[b] = {get(p.bodies, at), square(p.bodies, at + 1), square(p.bodies, at + 10), triple(p.bodies, at + 19)};
        s[b] = {triple(p.states, from), triple(p.states, from + 3),
                {get(p.states, from + 6), triple(p.states, from + 7)}, triple(p.states, from + 10)};
    }
    V transition[2][4][6], rows[2][4][6], axis[2][6], sent[6], bias[6];
    int64_t intervals[6][W];
    for (int a = 0; a < 6; ++a) {
        for (int i = 0; i < 2; ++i) {
            for (int c = 0; c < 4; ++c) {
                transition[i][c][a] = get(p.transition, (i * 4 + c) * 6 + a);
                rows[i][c][a] = get(p.rows, (i * 4 + c) * 6 + a);
            }
            axis[i][a] = get(p.axes, i * 6 + a);
        }
        sent[a] = get(p.command, a);
        bias[a] = get(p.bias, a);
        for (int l = 0; l < W; ++l) intervals[a][l] = p.intervals[a * p.lanes + lane + l];
    }
    const V period = get(p.period, 0), radius = get(p.contact, 0);
    const Drogue drogue{get(p.contact, 1), get(p.contact, 2), get(p.contact, 3), get(p.contact, 4)};
    const V stiffness = get(p.contact, 5), damping = get(p.contact, 6), friction = get(p.contact, 7);
    const V slip_speed = get(p.contact, 8);
    const Vector centre = triple(p.contact, 9);
    const int64_t mask = p.ring - 1;
    std::vector<V> ring(p.ring * 12);
    for (int64_t row = 0; row < p.ring * 12; ++row) ring[row] = get(p.samples, row);

    for (int64_t tick = 0; tick < ticks; ++tick) {
        V at[6], rate[6];
        for (int a = 0; a < 6; ++a)
            for (int l = 0; l < W; ++l) {
                const V* sample = &ring[((tick - 1 - intervals[a][l]) & mask) * 12];
                at[a][l] = sample[a][l];
                rate[a][l] = sample[6 + a][l];
            }
        // The contact, on the hardware.
        const Vector place{at[0], at[1], at[2]}, theta{at[3], at[4], at[5]};
        const Vector angular = left_jacobian(theta, {rate[3], rate[4], rate[5]});
        const Vector arm = rotate(exponential(theta), centre), x = place + arm;
        Vector n;
        const V distance = surface(drogue, x, n), depth = radius - distance;
        const Vector point = x - distance * n;
        const Vector speed = Vector{rate[0], rate[1], rate[2]} + cross(angular, point - place);
        const V closing = -dot(n, speed);
        const Vector slip = speed + closing * n;
        const V pressed = depth > 0 ? depth : all(0);
        const V push = stiffness * pressed * root(pressed) * (1 + 1.5 * damping * closing);
        const V normal = push > 0 ? push : all(0);
        const V share = friction * normal / root(dot(slip, slip) + slip_speed * slip_speed);
        const Vector force = normal * n - share * slip, moment = cross(point, force);
        // The sensor reads the reaction.
        const V given[6] = {-force.x, -force.y, -force.z, -moment.x, -moment.y, -moment.z};
        V read[6];
        for (int row = 0; row < 6; ++row) read[row] = bias[row] + given[row];
        // The numerical model.
        const Vector offset = rotate(s[0].q, body[0].interface), origin = s[0].r + offset;
        const Vector f = rotate(s[0].q, {-read[0], -read[1], -read[2]});
        const Vector m = rotate(s[0].q, {-read[3], -read[4], -read[5]});
        const Vector on_target = m + cross(origin - s[0].r, f), on_chaser = m + cross(origin - s[1].r, f);
        kick_drift(body[0], s[0], {-f, -on_target}, period);
        kick_drift(body[1], s[1], {f, on_chaser}, period);
        // The command and the axes.
        const Vector apart = s[1].r + rotate(s[1].q, body[1].interface) - s[0].r - rotate(s[0].q, body[0].interface);
        const Vector wanted = back(s[0].q, apart), turn = logarithm(compose(reverse(s[0].q), s[1].q));
        const V command[6] = {wanted.x, wanted.y, wanted.z, turn.x, turn.y, turn.z};
        V* sample = &ring[(tick & mask) * 12];
        for (int a = 0; a < 6; ++a) {
            V value[2], next[2];
            for (int i = 0; i < 2; ++i) {
                value[i] = rows[i][0][a] * axis[0][a] + rows[i][1][a] * axis[1][a] + rows[i][2][a] * sent[a] +
                           rows[i][3][a] * command[a];
                next[i] = transition[i][0][a] * axis[0][a] + transition[i][1][a] * axis[1][a] +
                          transition[i][2][a] * sent[a] + transition[i][3][a] * command[a];
            }
            sample[a] = value[0];
            sample[6 + a] = value[1];
            axis[0][a] = next[0];
            axis[1][a] = next[1];
            sent[a] = command[a];
        }
    }
    for (int b = 0; b < 2; ++b) {
        const V out[13] = {s[b].r.x, s[b].r.y, s[b].r.z, s[b].v.x,    s[b].v.y,    s[b].v.z,   s[b].q.w,
                           s[b].q.v.x, s[b].q.v.y, s[b].q.v.z, s[b].spin.x, s[b].spin.y, s[b].spin.z};
        for (int i = 0; i < 13; ++i) store(p.states, 13 * b + i, p.lanes, lane, out[i]);
    }
}

}  // namespace

extern "C" double run_ticks(const Problem* p, int64_t ticks) {
    const auto begin = std::chrono::steady_clock::now();
    for (int64_t lane = 0; lane < p->lanes; lane += W) block(*p, lane, ticks);
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
}
