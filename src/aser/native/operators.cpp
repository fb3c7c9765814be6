// The loops of a step for which torch has no good operator; native/__init__.py says why.
//
// Networks have one hidden layer of ReLU units. Their weights are w1 (G, hidden, inputs), b1 (G,
// hidden), w2 (G, outputs, hidden) and b2 (G, outputs), for x (G / copies, inputs, columns). There
// are at most MAX_INPUTS inputs and MAX_OUTPUTS outputs. The hidden layer stays in registers, and
// gradients compute it again.

#include <ATen/cpu/vec/vec.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <type_traits>

#if defined(__clang__)
#pragma clang fp contract(fast)
#else
#pragma GCC push_options
#pragma GCC optimize("O3", "fp-contract=fast")
#endif

namespace {

#if defined(__AVX512F__)
constexpr long REGISTER = 64;
#elif defined(__AVX__)
constexpr long REGISTER = 32;
#else
constexpr long REGISTER = 16;
#endif
// The numbers of a register. GCC keeps wider vectors in memory, which is tens of times slower.
constexpr long WIDTH = REGISTER / sizeof(float);
constexpr long MAX_INPUTS = 32, MAX_OUTPUTS = 8, FANOUT = 16, MAX_TOP = 512;
constexpr long TOGETHER = 4;  // what is read once serves so many units, inputs or outputs
typedef float Vector __attribute__((vector_size(REGISTER)));

inline Vector spread(float value) { return value - Vector{}; }

inline Vector relu(Vector x) { return x < 0 ? Vector{} : x; }  // keeps a NaN

// The sum of N numbers: one half is added to the other until one number is left.
template <long N>
inline float sum_of(const float* x) {
    if constexpr (N == 1) {
        return x[0];
    } else {
        typedef float Half __attribute__((vector_size(N / 2 * sizeof(float))));
        Half half[2];
        std::memcpy(half, x, sizeof(half));
        half[0] += half[1];
        return sum_of<N / 2>(reinterpret_cast<const float*>(half));
    }
}

inline float total(Vector x) { return sum_of<WIDTH>(reinterpret_cast<const float*>(&x)); }

// Load WIDTH columns, from column `from` on, of x (rows, columns) as vectors; past the end they are
// 0.
inline void load(Vector* block, const float* x, long rows, long columns, long from) {
    const long count = std::max(0L, std::min(WIDTH, columns - from));
    for (long r = 0; r < rows; ++r) {
        if (count < WIDTH) block[r] = Vector{};
        std::memcpy(block + r, x + r * columns + from, count * sizeof(float));
    }
}

inline void store(float* y, const Vector* block, long rows, long columns, long from) {
    const long count = std::max(0L, std::min(WIDTH, columns - from));
    for (long r = 0; r < rows; ++r)
        std::memcpy(y + r * columns + from, block + r, count * sizeof(float));
}

// Some hidden units at two blocks of columns, which hide each other's latency. The blocks of the
// i-th input are in[i * per_input] and the one `further` behind it.
template <long UNITS>
__attribute__((always_inline)) inline void hidden_units(
    Vector (*unit)[2], const float* w1, const float* b1, const Vector* in, long inputs,
    long per_input, long further) {
    for (long k = 0; k < UNITS; ++k) unit[k][0] = unit[k][1] = spread(b1[k]);
    for (long i = 0; i < inputs; ++i) {
        const Vector first = in[i * per_input], second = in[i * per_input + further];
        for (long k = 0; k < UNITS; ++k) {
            unit[k][0] += w1[k * inputs + i] * first;
            unit[k][1] += w1[k * inputs + i] * second;
        }
    }
}

// Call `some` for all of 0, 1, ..., count - 1: for TOGETHER of them at a time, then for one.
template <typename Some>
inline void in_groups(long count, Some some) {
    long k = 0;
    for (; k + TOGETHER <= count; k += TOGETHER) some(std::integral_constant<long, TOGETHER>(), k);
    for (; k < count; ++k) some(std::integral_constant<long, 1>(), k);
}

// The outputs at two blocks of columns.
template <long OUT>
void outputs_of(const float* w1, const float* b1, const float* w2, const float* b2,
                const Vector (*in)[MAX_INPUTS], Vector (*out)[OUT], long inputs, long hidden) {
    for (long v = 0; v < 2; ++v)
        for (long o = 0; o < OUT; ++o) out[v][o] = spread(b2[o]);
    in_groups(hidden, [&](auto units, long h) {
        Vector unit[units][2];
        hidden_units<units>(unit, w1 + h * inputs, b1 + h, in[0], inputs, 1, MAX_INPUTS);
        for (long k = 0; k < units; ++k)
            for (long o = 0; o < OUT; ++o)
                for (long v = 0; v < 2; ++v) out[v][o] += w2[o * hidden + h + k] * relu(unit[k][v]);
    });
}

template <long OUT>
void forward(const float* w1, const float* b1, const float* w2, const float* b2, const float* x,
             float* y, long inputs, long hidden, long columns) {
    Vector in[2][MAX_INPUTS], out[2][OUT];
    for (long from = 0; from < columns; from += 2 * WIDTH) {
        for (long v = 0; v < 2; ++v) load(in[v], x, inputs, columns, from + v * WIDTH);
        outputs_of<OUT>(w1, b1, w2, b2, in, out, inputs, hidden);
        for (long v = 0; v < 2; ++v) store(y, out[v], OUT, columns, from + v * WIDTH);
    }
}

// The gradient gx (inputs, columns) of the input, from the gradient gy (outputs, columns) of the
// output. `grad` is scratch memory.
template <long OUT>
void to_input(const float* w1, const float* b1, const float* w2, const float* x, const float* gy,
              float* gx, long inputs, long hidden, long columns, Vector (*grad)[2]) {
    Vector in[2][MAX_INPUTS], grad_out[2][OUT];
    for (long from = 0; from < columns; from += 2 * WIDTH) {
        for (long v = 0; v < 2; ++v) {
            load(in[v], x, inputs, columns, from + v * WIDTH);
            load(grad_out[v], gy, OUT, columns, from + v * WIDTH);
        }
        in_groups(hidden, [&](auto units, long h) {
            Vector unit[units][2];
            hidden_units<units>(unit, w1 + h * inputs, b1 + h, in[0], inputs, 1, MAX_INPUTS);
            for (long k = 0; k < units; ++k)
                for (long v = 0; v < 2; ++v) {
                    Vector sum = Vector{};
                    for (long o = 0; o < OUT; ++o) sum += w2[o * hidden + h + k] * grad_out[v][o];
                    grad[h + k][v] = unit[k][v] > 0 ? sum : Vector{};
                }
        });
        in_groups(inputs, [&](auto some, long i) {
            Vector sum[2][some] = {};
            for (long h = 0; h < hidden; ++h)
                for (long k = 0; k < some; ++k)
                    for (long v = 0; v < 2; ++v) sum[v][k] += w1[h * inputs + i + k] * grad[h][v];
            for (long v = 0; v < 2; ++v)
                store(gx + i * columns, sum[v], some, columns, from + v * WIDTH);
        });
    }
}

// The sums over all columns of the products of `a` (blocks) with each of `rows` (count, blocks).
inline void products(const Vector* a, const Vector* rows, float* y, long count, long apart,
                     long blocks) {
    in_groups(count, [&](auto some, long r) {
        Vector even[some] = {}, odd[some] = {};
        for (long c = 0; c < blocks; c += 2)
            for (long k = 0; k < some; ++k) {
                even[k] += a[c] * rows[(r + k) * blocks + c];
                odd[k] += a[c + 1] * rows[(r + k) * blocks + c + 1];
            }
        for (long k = 0; k < some; ++k) y[(r + k) * apart] = total(even[k] + odd[k]);
    });
}

// The gradients of the weights. `in` (inputs, blocks) holds x and `grad_out` (outputs, blocks)
// holds gy; `unit` and `grad`, (TOGETHER, blocks) each, are scratch memory. `blocks` is even.
template <long OUT>
void to_weights(const float* w1, const float* b1, const float* w2, const Vector* in,
                const Vector* grad_out, Vector* unit, Vector* grad, float* gw1, float* gb1,
                float* gw2, float* gb2, long inputs, long hidden, long blocks) {
    in_groups(hidden, [&](auto units, long h) {
        Vector sum[units] = {};
        for (long c = 0; c < blocks; c += 2) {
            Vector x[units][2];
            hidden_units<units>(x, w1 + h * inputs, b1 + h, in + c, inputs, blocks, 1);
            for (long k = 0; k < units; ++k)
                for (long v = 0; v < 2; ++v) {
                    Vector gradient = Vector{};
                    for (long o = 0; o < OUT; ++o)
                        gradient += w2[o * hidden + h + k] * grad_out[o * blocks + c + v];
                    gradient = x[k][v] > 0 ? gradient : Vector{};
                    unit[k * blocks + c + v] = relu(x[k][v]);
                    grad[k * blocks + c + v] = gradient;
                    sum[k] += gradient;
                }
        }
        for (long k = 0; k < units; ++k) {
            gb1[h + k] = total(sum[k]);
            products(grad + k * blocks, in, gw1 + (h + k) * inputs, inputs, 1, blocks);
            products(unit + k * blocks, grad_out, gw2 + h + k, OUT, hidden, blocks);
        }
    });
    for (long o = 0; o < OUT; ++o) {
        Vector sum = Vector{};
        for (long c = 0; c < blocks; ++c) sum += grad_out[o * blocks + c];
        gb2[o] = total(sum);
    }
}

// The smaller of two critics at `points` actions, q (points, columns), for the states x (dims,
// columns). The second critic's weights follow the first's. of_action (2, hidden, points) is the
// first layer's product with each action.
void grid(const float* w1, const float* b1, const float* w2, const float* b2, const float* x,
          const float* of_action, float* q, long dims, long inputs, long hidden, long points,
          long columns, Vector* of_state, Vector* least) {
    Vector in[2][MAX_INPUTS];
    for (long from = 0; from < columns; from += 2 * WIDTH) {
        for (long v = 0; v < 2; ++v) load(in[v], x, dims, columns, from + v * WIDTH);
        for (long critic = 0; critic < 2; ++critic) {
            const float *const weights = w1 + critic * hidden * inputs, *const outward =
                                                                            w2 + critic * hidden;
            const float *const bias = b1 + critic * hidden, *const actions =
                                                                of_action +
                                                                critic * hidden * points;
            for (long h = 0; h < hidden; ++h)
                for (long v = 0; v < 2; ++v) {
                    Vector unit = spread(bias[h]);
                    for (long i = 0; i < dims; ++i) unit += weights[h * inputs + i] * in[v][i];
                    of_state[2 * h + v] = unit;
                }
            for (long k = 0; k < points; ++k) {
                Vector out[2] = {spread(b2[critic]), spread(b2[critic])};
                for (long h = 0; h < hidden; ++h)
                    for (long v = 0; v < 2; ++v)
                        out[v] += outward[h] * relu(of_state[2 * h + v] + actions[h * points + k]);
                for (long v = 0; v < 2; ++v) {
                    const Vector other = critic == 0 ? out[v] : least[2 * k + v];
                    // A NaN of either critic is kept.
                    least[2 * k + v] = (other < out[v]) | (other != other) ? other : out[v];
                }
            }
        }
        for (long v = 0; v < 2; ++v)
            for (long k = 0; k < points; ++k)
                store(q + k * columns, least + 2 * k + v, 1, columns, from + v * WIDTH);
    }
}

typedef double Quarter __attribute__((vector_size(FANOUT / 4 * sizeof(double))));

// The numbers of a family (FANOUT) reduced by `op`, of which `before` changes each first.
template <typename Before, typename Op>
inline double reduced(const double* family, Before before, Op op) {
    Quarter part[4];
    std::memcpy(part, family, sizeof(part));
    for (Quarter& one : part) one = before(one);
    const Quarter last = op(op(part[0], part[2]), op(part[1], part[3]));
    return op(op(last[0], last[2]), op(last[1], last[3]));
}

inline long last_with_mass(const double* family, long size) {
    long last = size - 1;
    while (last > 0 && !(family[last] > 0)) --last;
    return last;
}

#define BY_OUTPUTS(f) f<1>, f<2>, f<3>, f<4>, f<5>, f<6>, f<7>, f<8>

}  // namespace

extern "C" void networks(const float* w1, const float* b1, const float* w2, const float* b2,
                         const float* x, float* y, long groups, long copies, long inputs,
                         long hidden, long outputs, long columns) {
    static const decltype(&forward<1>) sized[] = {BY_OUTPUTS(forward)};
    for (long g = 0; g < groups; ++g)
        sized[outputs - 1](w1 + g * hidden * inputs, b1 + g * hidden, w2 + g * outputs * hidden,
                           b2 + g * outputs, x + g / copies * inputs * columns,
                           y + g * outputs * columns, inputs, hidden, columns);
}

extern "C" void grids(const float* w1, const float* b1, const float* w2, const float* b2,
                      const float* x, const float* of_action, float* q, long groups, long dims,
                      long inputs, long hidden, long points, long columns) {
    Vector* const scratch = new Vector[2 * hidden + 2 * points];
    for (long g = 0; g < groups; ++g)
        grid(w1 + 2 * g * hidden * inputs, b1 + 2 * g * hidden, w2 + 2 * g * hidden, b2 + 2 * g,
             x + g * dims * columns, of_action + 2 * g * hidden * points, q + g * points * columns,
             dims, inputs, hidden, points, columns, scratch, scratch + 2 * hidden);
    delete[] scratch;
}

// The caller sums gx (G, inputs, columns) over the copies.
extern "C" void networks_to_input(const float* w1, const float* b1, const float* w2, const float* x,
                                  const float* gy, float* gx, long groups, long copies, long inputs,
                                  long hidden, long outputs, long columns) {
    static const decltype(&to_input<1>) sized[] = {BY_OUTPUTS(to_input)};
    Vector(*const scratch)[2] = new Vector[hidden][2];
    for (long g = 0; g < groups; ++g)
        sized[outputs - 1](w1 + g * hidden * inputs, b1 + g * hidden, w2 + g * outputs * hidden,
                           x + g / copies * inputs * columns, gy + g * outputs * columns,
                           gx + g * inputs * columns, inputs, hidden, columns, scratch);
    delete[] scratch;
}

extern "C" void networks_to_weights(const float* w1, const float* b1, const float* w2,
                                    const float* x, const float* gy, float* gw1, float* gb1,
                                    float* gw2, float* gb2, long groups, long copies, long inputs,
                                    long hidden, long outputs, long columns) {
    static const decltype(&to_weights<1>) sized[] = {BY_OUTPUTS(to_weights)};
    const long blocks = (columns + 2 * WIDTH - 1) / (2 * WIDTH) * 2;
    Vector* const in = new Vector[blocks * (inputs + outputs + 2 * TOGETHER)];
    Vector *const grad_out = in + blocks * inputs, *const unit = grad_out + blocks * outputs,
                  *const grad = unit + blocks * TOGETHER;
    for (long g = 0; g < groups; ++g) {
        const float *const xg = x + g / copies * inputs * columns, *const gyg =
                                                                       gy + g * outputs * columns;
        for (long c = 0; c < blocks; ++c) {
            for (long i = 0; i < inputs; ++i)
                load(in + i * blocks + c, xg + i * columns, 1, columns, c * WIDTH);
            for (long o = 0; o < outputs; ++o)
                load(grad_out + o * blocks + c, gyg + o * columns, 1, columns, c * WIDTH);
        }
        sized[outputs - 1](w1 + g * hidden * inputs, b1 + g * hidden, w2 + g * outputs * hidden, in,
                           grad_out, unit, grad, gw1 + g * hidden * inputs, gb1 + g * hidden,
                           gw2 + g * outputs * hidden, gb2 + g * outputs, inputs, hidden, blocks);
    }
    delete[] in;
}

// A tree of masses over each lane's items has `levels` arrays (lanes, width), leaves first. Each
// node is the sum of its FANOUT children, and the last level has at most MAX_TOP nodes.
// replay/priorities.py describes the tree.
//
// Draw items: walk down to the item before which the share u (lanes, count) of the total mass lies,
// and return its `index` and `mass`. Each level is finished for all u before the next one begins,
// so the processor has many independent sums at a time.
extern "C" void draw(const double* const* sums, const long* width, const double* u, long* index,
                     double* mass, long levels, long lanes, long count) {
    double* const rest = new double[count];
    const long tops = width[levels - 1];
    for (long lane = 0; lane < lanes; ++lane, u += count, index += count, mass += count) {
        const double* const top = sums[levels - 1] + lane * tops;
        double cumulative[2 * MAX_TOP] = {0};  // infinite past the end: the search needs no bound
        for (long i = 0; i < tops; ++i) cumulative[i + 1] = cumulative[i] + top[i];
        std::fill(cumulative + tops + 1, cumulative + 2 * MAX_TOP, INFINITY);
        for (long b = 0; b < count; ++b) {
            const double at = u[b] * cumulative[tops];
            long node = 0;  // the number of nodes that end before `at`
            for (long step = MAX_TOP; step > 0; step /= 2)
                node += cumulative[node + step] <= at ? step : 0;
            index[b] = node < tops ? node : last_with_mass(top, tops);
            rest[b] = at - cumulative[index[b]];
        }
        for (long level = levels - 2; level >= 0; --level) {
            const double* const nodes = sums[level] + lane * width[level];
            for (long b = 0; b < count; ++b) {
                const double* const family = nodes + index[b] * FANOUT;
                long child = 0;
                double sum = 0, before = 0;
                for (long i = 0; i < FANOUT; ++i) {
                    sum += family[i];
                    child += sum <= rest[b];
                    before = sum <= rest[b] ? sum : before;
                }
                if (child == FANOUT) {  // after rounding, the rest equals the family's mass
                    child = last_with_mass(family, FANOUT);
                    before -= family[child];
                }
                rest[b] -= before;
                index[b] = index[b] * FANOUT + child;
            }
        }
        for (long b = 0; b < count; ++b) mass[b] = sums[0][lane * width[0] + index[b]];
    }
    delete[] rest;
}

// Set the mass of the items at `index` (lanes, count), and recompute the nodes above them: the sum,
// the largest, and the smallest above zero.
extern "C" void write_masses(double* const* sums, double* const* most, double* const* least,
                      const long* width, const long* index, const double* mass, long levels,
                      long lanes, long count) {
    const auto same = [](Quarter x) { return x; };
    const auto above_zero = [](Quarter x) { return x > 0 ? x : INFINITY - Quarter{}; };
    const auto sum = [](auto a, auto b) { return a + b; };
    const auto larger = [](auto a, auto b) { return a > b ? a : b; };
    const auto smaller = [](auto a, auto b) { return a < b ? a : b; };
    for (long lane = 0; lane < lanes; ++lane, index += count, mass += count) {
        for (long b = 0; b < count; ++b) sums[0][lane * width[0] + index[b]] = mass[b];
        for (long level = 1, step = FANOUT; level < levels; ++level, step *= FANOUT) {
            const bool all = width[level] <= count;
            for (long b = 0; b < (all ? std::min(width[level], width[level - 1] / FANOUT) : count);
                 ++b) {
                const long node = all ? b : index[b] / step, at = lane * width[level] + node;
                const long child = lane * width[level - 1] + node * FANOUT;
                sums[level][at] = reduced(sums[level - 1] + child, same, sum);
                most[level][at] = reduced(most[level - 1] + child, same, larger);
                least[level][at] = reduced(least[level - 1] + child, above_zero, smaller);
            }
        }
    }
}

// The rows `at` (lanes, count) of tables (lanes, rows, width) of running moments after the outcomes x
// (lanes, numbers, count), one by one. The tables stay as they are. Row: visits, means, and a
// variance for each part, of which `sizes` says how many numbers it has. replay/moments.py describes
// them.
extern "C" void observe(const float* tables, const long* at, const float* x, const long* sizes,
                        const float* rate, float* after, long lanes, long rows, long numbers,
                        long parts, long count) {
    const long width = 1 + numbers + parts;
    long* const first = new long[rows];  // the first outcome of a row, where the row is summed
    for (long lane = 0; lane < lanes; ++lane) {
        for (long b = count - 1; b >= 0; --b) {
            first[at[b]] = b;
            __builtin_prefetch(tables + at[b] * width);  // rows come from far away
        }
        for (long b = 0; b < count; ++b) {
            float *const row = after + first[at[b]] * width, *mean = row + 1,
                         *const variance = mean + numbers;
            if (first[at[b]] == b)
                std::memcpy(row, tables + at[b] * width, width * sizeof(float));
            const float* value = x + b;
            for (long part = 0; part < parts; ++part) {
                float square = 0;
                for (long i = 0; i < sizes[part]; ++i, ++mean, value += count) {
                    const float distance = *value - *mean;
                    *mean = row[0] == 0 ? *value : *mean + *rate * distance;
                    square += distance * distance;
                }
                variance[part] =
                    row[0] == 0 ? 0 : (1 - *rate) * (variance[part] + *rate * square);
            }
            row[0] += 1;
        }
        for (long b = 0; b < count; ++b)
            if (first[at[b]] != b)
                std::memcpy(after + b * width, after + first[at[b]] * width, width * sizeof(float));
        tables += rows * width, at += count, x += numbers * count, after += count * width;
    }
    delete[] first;
}

// For each row of x (rows, columns), which is rearranged: the value at its rank and the next one in
// order, as y (rows, 2).
extern "C" void neighbours(float* x, const long* rank, float* y, long rows, long columns) {
    for (long r = 0; r < rows; ++r, x += columns) {
        float* const ranked = x + rank[r];
        std::nth_element(x, ranked, x + columns);
        y[2 * r] = *ranked;
        y[2 * r + 1] =
            ranked + 1 == x + columns ? *ranked : *std::min_element(ranked + 1, x + columns);
    }
}

// From here on sums are rounded as torch rounds them, for the walk to give the plain lines' numbers.
#if defined(__clang__)
#pragma clang fp contract(off)
#else
#pragma GCC pop_options
#endif

namespace {

typedef at::vec::Vectorized<float> Floats;  // its functions are those of torch's compiled code

constexpr long PAIR = 2 * WIDTH;
static_assert(PAIR % Floats::size() == 0);
constexpr float LOG_2 = 0.6931471805599453, HALF_LOG_2PI = 0.9189385332046727;
constexpr float LOG_STD_MIN = -20, LOG_STD_MAX = 2;

inline Floats log_tanh_slope(Floats u) {
    const Floats distance = u.abs();
    return (Floats(LOG_2) - distance - ((distance * Floats(-2)).exp() + Floats(1)).log()) *
           Floats(2);
}

// What agents/networks.py calls sample, for PAIR columns: the log-density of the action of epsilon.
// mean, log_std and epsilon are (actions, PAIR).
void sampled_log_prob(const float* mean, const float* log_std, const float* epsilon,
                      float* log_prob, long actions) {
    for (long from = 0; from < PAIR; from += Floats::size()) {
        Floats sum(0);
        for (long a = 0; a < actions; ++a) {
            const long at = a * PAIR + from;
            const Floats drawn = Floats::loadu(epsilon + at), width = Floats::loadu(log_std + at);
            const Floats u = Floats::loadu(mean + at) + width.exp() * drawn;
            const Floats one = drawn * drawn * Floats(-0.5) - width - Floats(HALF_LOG_2PI) -
                               log_tanh_slope(u);
            sum = a == 0 ? one : sum + one;
        }
        sum.store(log_prob + from);
    }
}

// The criterion mode_log_prob of PAIR columns: log(1 + pi) at the policy's mode.
void mode_log_prob(const float* mean, const float* log_std, float* p, long actions,
                   bool squashed) {
    for (long from = 0; from < PAIR; from += Floats::size()) {
        Floats sum(0);
        for (long a = 0; a < actions; ++a) {
            const long at = a * PAIR + from;
            Floats one = Floats::loadu(log_std + at).neg() - Floats(HALF_LOG_2PI);
            if (squashed) one = one - log_tanh_slope(Floats::loadu(mean + at));
            sum = a == 0 ? one : sum + one;
        }
        Floats::blendv(sum.exp().log1p(), sum, sum > Floats(20)).store(p + from);
    }
}

struct Replay {
    const float* rows;  // (capacity, width)
    long capacity, width, newest, reward, terminated, truncated, next_obs;  // the last are columns

    const float* row(long at) const { return rows + at * width; }

    const float* after(const float* row) const {
        return row + width == rows + capacity * width ? rows : row + width;
    }

    bool last(const float* row) const {
        return row[terminated] > 0.5f || row[truncated] > 0.5f || row == rows + newest * width;
    }
};

struct Actor {
    const float *w1, *b1, *w2, *b2;
    long inputs, hidden;
};

enum Criterion : long { NONE, SQUASHED, GAUSSIAN };

struct Walker {
    const float* row;  // of the replay: its next observation is the state where the walker stands
    long item, steps;
    float sum;
};

// Walk the windows of one lane's items. PAIR walkers go side by side, one step at a time, and one
// that has come to the end of its window begins with the next item.
template <long OUT>
void walk_lane(const Replay& replay, const Actor& actor, const long* index, const long* limit,
               const float* epsilon, const float* powers, float temperature, float b,
               long criterion, long* n, float* reward, float* discount, long* final, long count) {
    constexpr long ACTIONS = OUT / 2;
    Vector in[2][MAX_INPUTS] = {}, out[2][OUT];
    float mean[ACTIONS][PAIR], log_std[ACTIONS][PAIR], drawn[ACTIONS][PAIR] = {}, log_prob[PAIR],
        p[PAIR];
    Walker walkers[PAIR];
    long started = 0, walking = 0;

    const auto fetch = [&](long i) {  // the rows of a window come from far away
        if (i >= count) return;
        const float* const row = replay.row(index[i]);
        for (long k = 0; k < limit[i] * replay.width; k += WIDTH) __builtin_prefetch(row + k);
    };
    const auto finish = [&](const Walker& walker) {
        const long i = walker.item, at = index[i] + walker.steps - 1;
        n[i] = walker.steps;
        reward[i] = walker.sum;
        discount[i] = walker.row[replay.terminated] > 0.5f ? 0.0f : powers[walker.steps];
        final[i] = at < replay.capacity ? at : at - replay.capacity;
    };
    const auto start = [&](long k) {  // false when no item is left
        while (started < count) {
            const long i = started++;
            fetch(i + PAIR);
            const float* const row = replay.row(index[i]);
            walkers[k] = {row, i, 1, powers[0] * row[replay.reward]};
            for (long a = 0; a < ACTIONS; ++a) drawn[a][k] = epsilon[a * count + i];
            if (limit[i] > 1 && !replay.last(row)) return true;
            finish(walkers[k]);
        }
        return false;
    };

    for (long i = 0; i < PAIR; ++i) fetch(i);
    while (walking < PAIR && start(walking)) ++walking;
    while (walking > 0) {
        for (long i = 0; i < actor.inputs; ++i)
            for (long k = 0; k < walking; ++k)
                reinterpret_cast<float*>(&in[k / WIDTH][i])[k % WIDTH] =
                    walkers[k].row[replay.next_obs + i];
        outputs_of<OUT>(actor.w1, actor.b1, actor.w2, actor.b2, in, out, actor.inputs,
                        actor.hidden);
        for (long a = 0; a < ACTIONS; ++a)
            for (long v = 0; v < 2; ++v) {
                Vector width = out[v][ACTIONS + a];
                width = width < LOG_STD_MIN ? spread(LOG_STD_MIN) : width;
                width = width > LOG_STD_MAX ? spread(LOG_STD_MAX) : width;
                std::memcpy(mean[a] + v * WIDTH, &out[v][a], sizeof(Vector));
                std::memcpy(log_std[a] + v * WIDTH, &width, sizeof(Vector));
            }
        if (criterion != NONE)
            mode_log_prob(mean[0], log_std[0], p, ACTIONS, criterion == SQUASHED);
        sampled_log_prob(mean[0], log_std[0], drawn[0], log_prob, ACTIONS);
        for (long k = walking - 1; k >= 0; --k) {
            Walker& walker = walkers[k];
            if (criterion == NONE || p[k] < b) {
                walker.row = replay.after(walker.row);
                walker.sum += powers[walker.steps++] *
                              (walker.row[replay.reward] + -temperature * log_prob[k]);
                if (walker.steps < limit[walker.item] && !replay.last(walker.row)) continue;
            }
            finish(walker);
            if (start(k)) continue;
            walkers[k] = walkers[--walking];
            for (long a = 0; a < ACTIONS; ++a) drawn[a][k] = drawn[a][walking];
        }
    }
}

}  // namespace

// Unroll the drawn items `index` (lanes, count) of the replay `rows` (lanes, capacity, width): each
// over at most `limit` steps, and no further than the end of its episode or the newest item. Past
// s_1, s_2, ... only while p < b, where a criterion is asked for. The path's entropy is added to
// the rewards, which gives `reward`; `final` is the item that holds s_n. The actor's weights are
// those of a network, `epsilon` is (lanes, actions, count), `powers` (lanes, steps) of gamma.
extern "C" void walk(const float* w1, const float* b1, const float* w2, const float* b2,
                     const float* rows, const long* newest, const long* index, const long* limit,
                     const float* epsilon, const float* powers, const float* temperature,
                     const float* b, long* n, float* reward, float* discount, long* final,
                     long lanes, long inputs, long hidden, long outputs, long capacity, long width,
                     long steps, long count, long criterion, long column_reward,
                     long column_terminated, long column_truncated, long column_next_obs) {
    static const decltype(&walk_lane<2>) sized[] = {walk_lane<2>, walk_lane<4>, walk_lane<6>,
                                                    walk_lane<8>};
    for (long lane = 0; lane < lanes; ++lane) {
        const Replay replay = {rows + lane * capacity * width,
                               capacity,
                               width,
                               newest[lane],
                               column_reward,
                               column_terminated,
                               column_truncated,
                               column_next_obs};
        const Actor actor = {w1 + lane * hidden * inputs,
                             b1 + lane * hidden,
                             w2 + lane * outputs * hidden,
                             b2 + lane * outputs,
                             inputs,
                             hidden};
        const long first = lane * count;
        sized[outputs / 2 - 1](replay, actor, index + first, limit + first,
                               epsilon + first * (outputs / 2), powers + lane * steps,
                               temperature[lane], b[lane], criterion, n + first, reward + first,
                               discount + first, final + first, count);
    }
}
