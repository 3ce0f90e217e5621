/* The yardstick: one step of car following with the gated Kalman filter, in C, as fast as a compiler makes it without fast-math.

   Leader (stop-and-go), two noisy measurements, an injection from a table, the 3-state filter with its covariance and gate, adaptive
   cruise control with actuator lag, reward, autoreset; in `whole` also process noise and the driver behind, as the scenario has them.
   Formulas and random numbers (Philox4x32-10, Box-Muller) are those of the Python loop: its trajectories agree to rounding.

   Episodes lie in blocks of LANES: state[block][row][lane], words[block][row][lane]. Constants come as an array, in the order of `enum
   constant`; the table holds the bias of both readings by step, table[2][horizon + 1]. */

#include <math.h>
#include <stdint.h>

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

#define LANES 64
#define REACTION 10
#define START 0xFFFFFFFFull
#define EACH(i) for (int i = 0; i < LANES; i++)

enum row {
    X, V, A, LEAD_X, LEAD_V, PHASE, CLOCK, EST_X, EST_V, EST_A, P00, P01, P02, P11, P12, P22, U, Y0, Y1, LEAST, POTENTIAL, REWARD,
    REAR_X, REAR_V, INTENT, ROWS = INTENT + REACTION
};
enum word { KEY, EPISODE, STEP, WORDS };
enum constant {
    DT, A02, A12, A22, B0, B1, B2, SD_X, SD_V, SD_A, Q0, Q1, Q2, R0, R1, SD_Y0, SD_Y1, PRIOR0, PRIOR1, PRIOR2, ETA, START_X, START_V, START_A,
    GAP, LEAD_SPEED, HEADWAY, STANDSTILL, GAMMA, SET_SPEED, ACCEL_MIN, ACCEL_MAX, CRUISE_LOW, CRUISE_HIGH, DWELL_LOW, DWELL_HIGH, DECEL,
    RATE, LOW_SPEED, CRUISE_SPEED, IDM_SPEED, IDM_HEADWAY, IDM_GAP, IDM_ACCEL, IDM_ROOT, IDM_BRAKE, GAP_SHAPING, ERROR_SHAPING, DISCOUNT,
    NEAR, HORIZON, PROCESS_STREAM, SENSOR_STREAM, LEADER_STREAM, CONSTANTS
};

static inline double least_of(double a, double b) { return a < b ? a : b; }
static inline double most_of(double a, double b) { return a > b ? a : b; }
static inline double within(double a, double low, double high) { return most_of(least_of(a, high), low); }
static inline double as_double(uint64_t w) { union { uint64_t w; double d; } u = {w}; return u.d; }
static inline uint64_t as_word(double d) { union { double d; uint64_t w; } u = {d}; return u.w; }

/* -- random numbers */

static inline double uniform_of(uint64_t high, uint64_t low) {
    uint64_t w = (high << 32 | low) >> 12; /* 52 bits, to a double by way of 2^52: no conversion of 64-bit integers is needed */
    return ((as_double(w | 0x4330000000000000ull) - 4503599627370496.0) + 0.5) * 2.220446049250313e-16;
}

static inline double log_of(double x) { /* of a uniform: normal, positive, finite */
    uint64_t bits = as_word(x);
    double m = as_double((bits & 0x000FFFFFFFFFFFFFull) | 0x3FE0000000000000ull);
    double e = as_double((bits >> 52) + 0x4330000000000000ull) - (4503599627370496.0 + 1022.0);
    int small = m < 0.7071067811865476;
    m = small ? 2.0 * m : m;
    e = small ? e - 1.0 : e;
    double s = (m - 1.0) / (m + 1.0), z = s * s, p = 1.0 / 23.0;
    p = p * z + 1.0 / 21.0; p = p * z + 1.0 / 19.0; p = p * z + 1.0 / 17.0; p = p * z + 1.0 / 15.0; p = p * z + 1.0 / 13.0;
    p = p * z + 1.0 / 11.0; p = p * z + 1.0 / 9.0; p = p * z + 1.0 / 7.0; p = p * z + 1.0 / 5.0; p = p * z + 1.0 / 3.0;
    p = p * z + 1.0;
    return e * 6.93147180369123816490e-01 + (2.0 * s * p + e * 1.90821492927058770002e-10);
}

static inline void sincos_turn(double u, double *sine, double *cosine) {
    double quarter = floor(4.0 * u + 0.5), t = 6.283185307179586 * (u - 0.25 * quarter), z = t * t;
    double s = 1.0 / 355687428096000.0, c = 1.0 / 20922789888000.0;
    s = s * z - 1.0 / 1307674368000.0; s = s * z + 1.0 / 6227020800.0; s = s * z - 1.0 / 39916800.0; s = s * z + 1.0 / 362880.0;
    s = s * z - 1.0 / 5040.0; s = s * z + 1.0 / 120.0; s = s * z - 1.0 / 6.0; s = (s * z + 1.0) * t;
    c = c * z - 1.0 / 87178291200.0; c = c * z + 1.0 / 479001600.0; c = c * z - 1.0 / 3628800.0; c = c * z + 1.0 / 40320.0;
    c = c * z - 1.0 / 720.0; c = c * z + 1.0 / 24.0; c = c * z - 0.5; c = c * z + 1.0;
    int odd = (quarter == 1.0) | (quarter == 3.0), late = (quarter == 2.0) | (quarter == 3.0), mid = (quarter == 1.0) | (quarter == 2.0);
    double a = odd ? c : s, b = odd ? s : c;
    *sine = late ? -a : a;
    *cosine = mid ? -b : b;
}

#if defined(__AVX512F__)
typedef uint64_t vec __attribute__((vector_size(64)));
static inline vec product(vec a, vec b) { return (vec)_mm512_mul_epu32((__m512i)a, (__m512i)b); }
#elif defined(__AVX2__)
typedef uint64_t vec __attribute__((vector_size(32)));
static inline vec product(vec a, vec b) { return (vec)_mm256_mul_epu32((__m256i)a, (__m256i)b); }
#else
typedef uint64_t vec __attribute__((vector_size(16)));
static inline vec product(vec a, vec b) { return a * b; }
#endif
typedef uint64_t loose __attribute__((vector_size(sizeof(vec)), aligned(8), may_alias)); /* a vec that lies anywhere */
#define WIDTH ((int)(sizeof(vec) / 8))

#define ROUNDS(c0, c1, c2, c3, k0, k1, times) \
    _Pragma("GCC unroll 10") for (int round = 0; round < 10; round++) { \
        p0 = times(m0, c0), p1 = times(m1, c2); \
        c0 = (p1 >> 32) ^ c1 ^ k0, c1 = p1 & mask, c2 = (p0 >> 32) ^ c3 ^ k1, c3 = p0 & mask; \
        k0 = (k0 + w0) & mask, k1 = (k1 + w1) & mask; \
    }

static inline __attribute__((always_inline)) void
uniforms(const uint64_t *w, uint64_t stream, uint64_t block, double *restrict u0, double *restrict u1) {
    const vec zero = {0}, mask = zero + 0xFFFFFFFFull, m0 = zero + 0xD2511F53ull, m1 = zero + 0xCD9E8D57ull;
    const vec w0 = zero + 0x9E3779B9ull, w1 = zero + 0xBB67AE85ull;
    uint64_t raw[4][LANES] __attribute__((aligned(64)));
    for (int i = 0; i < LANES; i += WIDTH) {
        vec key = (vec)*(const loose *)(w + KEY * LANES + i), k0 = key & mask, k1 = key >> 32, p0, p1;
        vec c0 = (vec)*(const loose *)(w + EPISODE * LANES + i), c1 = zero + block, c2 = (vec)*(const loose *)(w + STEP * LANES + i), c3 = zero + stream;
        ROUNDS(c0, c1, c2, c3, k0, k1, product)
        *(loose *)(raw[0] + i) = c0, *(loose *)(raw[1] + i) = c1, *(loose *)(raw[2] + i) = c2, *(loose *)(raw[3] + i) = c3;
    }
    EACH(i) u0[i] = uniform_of(raw[0][i], raw[1][i]);
    EACH(i) u1[i] = uniform_of(raw[2][i], raw[3][i]);
}

/* Two standard normals a lane; the second row is left out where it is NULL. */
static inline __attribute__((always_inline)) void
normals(const uint64_t *w, uint64_t stream, uint64_t block, double *restrict a, double *restrict b) {
    double u0[LANES] __attribute__((aligned(64))), u1[LANES] __attribute__((aligned(64)));
    uniforms(w, stream, block, u0, u1);
    EACH(i) u0[i] = sqrt(-2.0 * log_of(u0[i]));
    EACH(i) {
        double s, c;
        sincos_turn(u1[i], &s, &c);
        a[i] = u0[i] * c;
        if (b) b[i] = u0[i] * s;
    }
}

#define TIMES(a, b) ((a) * (b))
static void uniform_pair(uint64_t key, uint64_t episode, uint64_t step, uint64_t stream, uint64_t block, double *u0, double *u1) {
    const uint64_t mask = 0xFFFFFFFFull, m0 = 0xD2511F53ull, m1 = 0xCD9E8D57ull, w0 = 0x9E3779B9ull, w1 = 0xBB67AE85ull;
    uint64_t c0 = episode, c1 = block, c2 = step, c3 = stream, k0 = key & mask, k1 = key >> 32, p0, p1;
    ROUNDS(c0, c1, c2, c3, k0, k1, TIMES)
    *u0 = uniform_of(c0, c1), *u1 = uniform_of(c2, c3);
}

static void normal_pair(uint64_t key, uint64_t episode, uint64_t step, uint64_t stream, uint64_t block, double *a, double *b) {
    double u0, u1, s, c;
    uniform_pair(key, episode, step, stream, block, &u0, &u1);
    double radius = sqrt(-2.0 * log_of(u0));
    sincos_turn(u1, &s, &c);
    *a = radius * c, *b = radius * s;
}

/* -- the parts of a step, of one lane */

static inline double cruise_control(const double *c, double x, double v, double lead_x, double lead_v) {
    double gap_error = lead_x - x - c[STANDSTILL] - c[HEADWAY] * v;
    double a = ((lead_v - v) + c[GAMMA] * gap_error) / c[HEADWAY];
    a = least_of(a, (c[SET_SPEED] - v) / c[HEADWAY]);
    return least_of(most_of(a, c[ACCEL_MIN]), c[ACCEL_MAX]);
}

static inline double driver(const double *c, double gap, double v, double lead) {
    double closing = v * (v - lead) / c[IDM_ROOT];
    double wanted = c[IDM_GAP] + most_of(0.0, v * c[IDM_HEADWAY] + closing);
    double free = (v / c[IDM_SPEED]) * (v / c[IDM_SPEED]), near = wanted / most_of(gap, 0.1);
    return within(c[IDM_ACCEL] * (1.0 - free * free - near * near), -c[IDM_BRAKE], c[IDM_ACCEL]);
}

static inline double potential(const double *c, double gap, double belief) {
    double near = 1.0 - within(gap, 0.0, 100.0) / 100.0, fooled = within(belief, 0.0, 20.0) / 10.0;
    return c[GAP_SHAPING] * near + c[ERROR_SHAPING] * fooled;
}

static inline double leader(const double *c, double phase, double speed) {
    double slow = most_of(-c[DECEL], (c[LOW_SPEED] - speed) / c[DT]), fast = least_of(c[RATE], (c[CRUISE_SPEED] - speed) / c[DT]);
    return phase == 1.0 ? slow : phase == 3.0 ? fast : 0.0;
}

static inline int phase_ends(const double *c, double phase, double clock, double speed) {
    int braked = speed <= c[LOW_SPEED], fast = speed >= c[CRUISE_SPEED], over = clock <= 0.0;
    return phase == 1.0 ? braked : phase == 3.0 ? fast : over;
}

static void next_phase(const double *c, double *s, const uint64_t *w, uint64_t step) {
    double u, other, phase = s[PHASE * LANES] == 3.0 ? 0.0 : s[PHASE * LANES] + 1.0;
    uniform_pair(w[KEY * LANES], w[EPISODE * LANES], step, (uint64_t)c[LEADER_STREAM], 0, &u, &other);
    s[PHASE * LANES] = phase;
    s[CLOCK * LANES] = phase == 0.0 ? c[CRUISE_LOW] + (c[CRUISE_HIGH] - c[CRUISE_LOW]) * u : c[DWELL_LOW] + (c[DWELL_HIGH] - c[DWELL_LOW]) * u;
}

/* The cars one step later, under s[U], n standard normals and what the driver behind decided REACTION steps ago. */
static inline __attribute__((always_inline)) void
move(const double *c, double *restrict s, int i, int slot, double n0, double n1, double n2, const int whole) {
    double x = s[X * LANES + i], v = s[V * LANES + i], a = s[A * LANES + i], u = s[U * LANES + i];
    double lead_x = s[LEAD_X * LANES + i], lead_v = s[LEAD_V * LANES + i];
    double x1 = x + c[DT] * v + c[A02] * a + c[B0] * u, v1 = v + c[A12] * a + c[B1] * u, a1 = c[A22] * a + c[B2] * u;
    if (whole) x1 += c[SD_X] * n0, v1 += c[SD_V] * n1, a1 += c[SD_A] * n2;
    int halted = v1 <= 0.0;
    s[X * LANES + i] = halted ? most_of(x1, x) : x1;
    s[V * LANES + i] = most_of(v1, 0.0);
    s[A * LANES + i] = halted ? most_of(a1, 0.0) : a1;
    double faster = most_of(0.0, lead_v + leader(c, s[PHASE * LANES + i], lead_v) * c[DT]);
    s[LEAD_X * LANES + i] = lead_x + 0.5 * c[DT] * (lead_v + faster);
    s[LEAD_V * LANES + i] = faster;
    if (whole) {
        double rear_x = s[REAR_X * LANES + i], rear_v = s[REAR_V * LANES + i], made = s[(INTENT + slot) * LANES + i];
        s[(INTENT + slot) * LANES + i] = driver(c, x - rear_x, rear_v, v);
        double next = most_of(0.0, rear_v + made * c[DT]);
        s[REAR_X * LANES + i] = rear_x + 0.5 * c[DT] * (rear_v + next);
        s[REAR_V * LANES + i] = next;
    }
}

/* A fresh episode in one lane (s and w point to it), measured at step 1; the driver behind writes into `slot` first. */
static void begin(const double *c, double *s, uint64_t *w, int slot, const int whole) {
    double n0 = 0.0, n1 = 0.0, n2 = 0.0, other;
    uint64_t key = w[KEY * LANES], episode = w[EPISODE * LANES];
    s[X * LANES] = s[EST_X * LANES] = c[START_X], s[V * LANES] = s[EST_V * LANES] = c[START_V], s[A * LANES] = s[EST_A * LANES] = c[START_A];
    s[LEAD_X * LANES] = c[START_X] + c[GAP], s[LEAD_V * LANES] = c[LEAD_SPEED];
    s[P00 * LANES] = c[PRIOR0], s[P11 * LANES] = c[PRIOR1], s[P22 * LANES] = c[PRIOR2];
    s[P01 * LANES] = s[P02 * LANES] = s[P12 * LANES] = 0.0;
    s[REAR_X * LANES] = c[START_X] - (c[IDM_GAP] + c[IDM_HEADWAY] * c[START_V]), s[REAR_V * LANES] = c[START_V];
    for (int r = 0; r < REACTION; r++) s[(INTENT + r) * LANES] = 0.0;
    s[U * LANES] = cruise_control(c, c[START_X], c[START_V], s[LEAD_X * LANES], s[LEAD_V * LANES]);
    s[PHASE * LANES] = 3.0; /* what follows is the cruise */
    next_phase(c, s, w, START);
    s[CLOCK * LANES] -= c[DT];
    if (phase_ends(c, s[PHASE * LANES], s[CLOCK * LANES], s[LEAD_V * LANES])) next_phase(c, s, w, 0);
    if (whole) {
        normal_pair(key, episode, 0, (uint64_t)c[PROCESS_STREAM], 0, &n0, &n1);
        normal_pair(key, episode, 0, (uint64_t)c[PROCESS_STREAM], 1, &n2, &other);
    }
    move(c, s, 0, slot, n0, n1, n2, whole);
    normal_pair(key, episode, 1, (uint64_t)c[SENSOR_STREAM], 0, &n0, &n1);
    s[Y0 * LANES] = s[X * LANES] + c[SD_Y0] * n0, s[Y1 * LANES] = s[V * LANES] + c[SD_Y1] * n1;
    double gap = s[LEAD_X * LANES] - s[X * LANES];
    s[LEAST * LANES] = within(gap, 0.0, c[NEAR]), s[POTENTIAL * LANES] = potential(c, gap, 0.0), s[REWARD * LANES] = 0.0;
    w[STEP * LANES] = 1;
}

/* Predict, gate, update, drive: rows EST_*, P* and U, from the readings and their biases. */
static inline __attribute__((always_inline)) void
estimate(const double *c, double *restrict s, const double *restrict b0, const double *restrict b1) {
    const double dt = c[DT], a02 = c[A02], a12 = c[A12], a22 = c[A22];
    EACH(i) {
        double u = s[U * LANES + i], ex = s[EST_X * LANES + i], ev = s[EST_V * LANES + i], ea = s[EST_A * LANES + i];
        double p00 = s[P00 * LANES + i], p01 = s[P01 * LANES + i], p02 = s[P02 * LANES + i];
        double p11 = s[P11 * LANES + i], p12 = s[P12 * LANES + i], p22 = s[P22 * LANES + i];
        double x = ex + dt * ev + a02 * ea + c[B0] * u, v = ev + a12 * ea + c[B1] * u, a = a22 * ea + c[B2] * u;
        double h00 = p00 + dt * p01 + a02 * p02, h01 = p01 + dt * p11 + a02 * p12, h02 = p02 + dt * p12 + a02 * p22;
        double h11 = p11 + a12 * p12, h12 = p12 + a12 * p22, h22 = a22 * p22;
        p00 = h00 + dt * h01 + a02 * h02 + c[Q0], p01 = h01 + a12 * h02, p02 = a22 * h02;
        p11 = h11 + a12 * h12 + c[Q1], p12 = a22 * h12, p22 = a22 * h22 + c[Q2];
        double r0 = s[Y0 * LANES + i] + b0[i] - x, r1 = s[Y1 * LANES + i] + b1[i] - v;
        double s00 = p00 + c[R0], s11 = p11 + c[R1], scale = 1.0 / (s00 * s11 - p01 * p01);
        double w00 = s11 * scale, w11 = s00 * scale, w01 = -p01 * scale;
        double score = r0 * (w00 * r0 + w01 * r1) + r1 * (w01 * r0 + w11 * r1);
        double open = score > c[ETA] ? 0.0 : 1.0;
        double k00 = (p00 * w00 + p01 * w01) * open, k01 = (p00 * w01 + p01 * w11) * open;
        double k10 = (p01 * w00 + p11 * w01) * open, k11 = (p01 * w01 + p11 * w11) * open;
        double k20 = (p02 * w00 + p12 * w01) * open, k21 = (p02 * w01 + p12 * w11) * open;
        x += k00 * r0 + k01 * r1, v += k10 * r0 + k11 * r1, a += k20 * r0 + k21 * r1;
        s[EST_X * LANES + i] = x, s[EST_V * LANES + i] = v, s[EST_A * LANES + i] = a;
        s[P00 * LANES + i] = p00 - (k00 * p00 + k01 * p01);
        s[P01 * LANES + i] = p01 - (k00 * p01 + k01 * p11);
        s[P02 * LANES + i] = p02 - (k00 * p02 + k01 * p12);
        s[P11 * LANES + i] = p11 - (k10 * p01 + k11 * p11);
        s[P12 * LANES + i] = p12 - (k10 * p02 + k11 * p12);
        s[P22 * LANES + i] = p22 - (k20 * p02 + k21 * p12);
        s[U * LANES + i] = cruise_control(c, x, v, s[LEAD_X * LANES + i], s[LEAD_V * LANES + i]);
    }
}

/* One step of a block; returns how many of its episodes ended, and began anew. */
static inline __attribute__((always_inline)) int64_t
step_block(const double *c, double *restrict s, uint64_t *restrict w, const double *restrict table, int slot, const int whole) {
    double n0[LANES] __attribute__((aligned(64))), n1[LANES] __attribute__((aligned(64))), n2[LANES] __attribute__((aligned(64)));
    double b0[LANES] __attribute__((aligned(64))), b1[LANES] __attribute__((aligned(64))), off[LANES] __attribute__((aligned(64)));
    double over[LANES] __attribute__((aligned(64)));
    const int64_t horizon = (int64_t)c[HORIZON];
    EACH(i) b0[i] = table[w[STEP * LANES + i]], b1[i] = table[horizon + 1 + w[STEP * LANES + i]];
    estimate(c, s, b0, b1);
    EACH(i) off[i] = s[X * LANES + i] - s[EST_X * LANES + i]; /* by how much the gap is overestimated */
    uint64_t any = 0;
    EACH(i) {
        s[CLOCK * LANES + i] -= c[DT];
        over[i] = phase_ends(c, s[PHASE * LANES + i], s[CLOCK * LANES + i], s[LEAD_V * LANES + i]) ? 1.0 : 0.0;
    }
    EACH(i) any |= as_word(over[i]);
    if (any) EACH(i) if (over[i] > 0.0) next_phase(c, s + i, w + i, w[STEP * LANES + i]);
    if (whole) {
        normals(w, (uint64_t)c[PROCESS_STREAM], 0, n0, n1);
        normals(w, (uint64_t)c[PROCESS_STREAM], 1, n2, 0);
    }
    EACH(i) move(c, s, i, slot, n0[i], n1[i], n2[i], whole);
    EACH(i) w[STEP * LANES + i] += 1;
    normals(w, (uint64_t)c[SENSOR_STREAM], 0, n0, n1);
    EACH(i) {
        double x = s[X * LANES + i], gap = s[LEAD_X * LANES + i] - x, before = s[LEAST * LANES + i], held = s[POTENTIAL * LANES + i];
        double rear = whole ? x - s[REAR_X * LANES + i] : 1.0, least = least_of(within(gap, 0.0, c[NEAR]), before);
        double hit = least_of(gap, rear) <= 0.0 ? 1.0 : 0.0, now = potential(c, gap, off[i]);
        s[Y0 * LANES + i] = x + c[SD_Y0] * n0[i], s[Y1 * LANES + i] = s[V * LANES + i] + c[SD_Y1] * n1[i];
        s[REWARD * LANES + i] = hit + (before - least) / c[NEAR] + c[DISCOUNT] * ((1.0 - hit) * now) - held;
        s[LEAST * LANES + i] = least, s[POTENTIAL * LANES + i] = now;
        over[i] = hit;
    }
    EACH(i) over[i] = w[STEP * LANES + i] > (uint64_t)horizon ? 1.0 : over[i];
    any = 0;
    EACH(i) any |= as_word(over[i]);
    int64_t ended = 0;
    if (any) EACH(i) if (over[i] > 0.0) {
        double gained = s[REWARD * LANES + i];
        w[EPISODE * LANES + i] += 1, ended += 1;
        begin(c, s + i, w + i, slot, whole);
        s[REWARD * LANES + i] = gained;
    }
    return ended;
}

#define RUN(name, whole) \
    void name##_start(int64_t blocks, double *state, uint64_t *words, const double *c) { \
        for (int64_t b = 0; b < blocks; b++) \
            EACH(i) begin(c, state + b * ROWS * LANES + i, words + b * WORDS * LANES + i, REACTION - 1, whole); \
    } \
    int64_t name(int64_t blocks, int64_t first, int64_t steps, double *state, uint64_t *words, const double *c, const double *table) { \
        int64_t ended = 0; \
        for (int64_t b = 0; b < blocks; b++) \
            for (int64_t t = first; t < first + steps; t++) \
                ended += step_block(c, state + b * ROWS * LANES, words + b * WORDS * LANES, table, (int)(t % REACTION), whole); \
        return ended; \
    }

RUN(whole, 1)
RUN(bare, 0)

int64_t rows(void) { return ROWS; }
int64_t constants(void) { return CONSTANTS; }
