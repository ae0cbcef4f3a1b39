/* Fits synthetic clusters with every model and option and prints the bits of the results: tests/kernels/test_same_bits.py
   compares what builds for several processors and by several compilers print.

   Nothing here depends on the processor: integers make the noise, exp_lanes of the library the pulses. Compiled with
   the library as one source, because only two of its functions are exported. */
#include "../../wavebatch/kernels/c/library.c"
#include <inttypes.h>
#include <stdio.h>

enum { WAVEFORMS = 24, LENGTH = 61, MOST_ECHOES = 24, ROWS = 129 };

typedef struct {
    const char *name;
    Pulse pulse;
    double clip, noise_gain, prior_spread, skew_spread;
    int64_t bytes, missing, per_sample, grow, undamped, whitened;
} Case;

static uint64_t state = 1;

/* Between 0 and 1, the same on every machine (multiplier and increment of Knuth's MMIX). */
static double draw(void) {
    state = state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    return (double)(state >> 11) * 0x1p-53;
}

static double bell(double z) { return exp_lanes(ALL(-0.5 * z * z))[0]; }

typedef struct {
    uint8_t one[WAVEFORMS * LENGTH], missing[WAVEFORMS * LENGTH];
    uint16_t two[WAVEFORMS * LENGTH];
    uint32_t four[WAVEFORMS * LENGTH];
    float real[WAVEFORMS * LENGTH], level[WAVEFORMS * LENGTH], std[WAVEFORMS];
    int64_t waveform[WAVEFORMS], low[WAVEFORMS], high[WAVEFORMS], first[WAVEFORMS], number[WAVEFORMS];
    double amplitude[3 * WAVEFORMS], time[3 * WAVEFORMS], width[3 * WAVEFORMS];
} Strip;

/* One to three echoes in each waveform, some at its ends or beside each other; candidates near the first ones. */
static void make_strip(Strip *strip) {
    int64_t candidates = 0;
    for (int64_t i = 0; i < WAVEFORMS; i++) {
        double time[3], height[3], width[3];
        int64_t echoes = 1 + i % 3, known = 1 + (i / 3) % echoes;
        for (int64_t j = 0; j < echoes; j++) {
            time[j] = j && i % 2 ? time[0] + 1.5 + 4 * draw() : LENGTH * draw();
            height[j] = 4 + 250 * draw() * draw(); width[j] = 1.6 + 1.2 * draw();
        }
        strip->waveform[i] = i; strip->first[i] = candidates; strip->number[i] = known;
        strip->low[i] = i % 5; strip->high[i] = LENGTH - i % 7;
        strip->std[i] = 0.8 + 0.5 * draw();
        for (int64_t x = 0; x < LENGTH; x++) {
            int64_t at = i * LENGTH + x;
            double y = 12 + 4 * (draw() + draw() + draw() - 1.5) * strip->std[i] / 2;
            for (int64_t j = 0; j < echoes; j++) y += height[j] * bell((x - time[j]) / width[j]);
            strip->real[at] = y; strip->two[at] = y; strip->four[at] = y; strip->one[at] = y > 255 ? 255 : y;
            strip->level[at] = 12 - 0.01 * x; strip->missing[at] = draw() < 0.05;
        }
        for (int64_t j = 0; j < known; j++, candidates++) {
            strip->amplitude[candidates] = height[j] * (0.7 + 0.6 * draw());
            strip->time[candidates] = time[j] + 2 * draw() - 1;
            strip->width[candidates] = 2;
        }
    }
}

static void print_number(double value) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    if (value == value) printf(" %016" PRIx64, bits);
    else printf(" nan"); /* whose bits differ by processor, and which Python writes as no-data */
}

static int run_case(const Case *c, const Strip *strip) {
    const void *samples = c->bytes == 1 ? (const void *)strip->one : c->bytes == 2 ? (const void *)strip->two
        : c->bytes == 4 ? (const void *)strip->four : (const void *)strip->real;
    Block block = {samples, LENGTH, c->bytes, strip->level, c->per_sample, strip->std, c->missing ? strip->missing : NULL, strip->std};
    Clusters clusters = {WAVEFORMS, strip->waveform, strip->low, strip->high, strip->first, strip->number, strip->amplitude, strip->time, strip->width};
    Settings settings = {.pulse = c->pulse, .width_ref = 2, .width_low = 1, .width_high = 12, .clip = c->clip, .noise_gain = c->noise_gain,
        .floor = c->clip < INFINITY ? 0 : -INFINITY, .tolerance = 1e-2, .acceptance = 15, .misfit = 0.001, .prior_spread = c->prior_spread, .gate_residual = 4.2, .gate_hermite = 8.5,
        .skew_mean = 0.05, .skew_spread = c->skew_spread, .max_iterations = 40, .max_echoes = 6, .grow = c->grow, .thorough = c->grow, .free_levels = c->whitened || c->noise_gain > 0, .undamped = c->undamped,
        .known = 3, .whitened = c->whitened, .whitening = {{1.7, 0, 0}, {2, -1.2, 0}, {2.2, -1.7, 0.4}}};
    static int64_t number[WAVEFORMS];
    static uint8_t converged[WAVEFORMS], at_bound[WAVEFORMS * MOST_ECHOES];
    static double misfit[WAVEFORMS * MOST_ECHOES], cost[WAVEFORMS], promise[WAVEFORMS];
    static double parameters[4 * WAVEFORMS * MOST_ECHOES], errors[4 * WAVEFORMS * MOST_ECHOES], shared[2 * WAVEFORMS * MOST_ECHOES];
    Echoes echoes = {WAVEFORMS * MOST_ECHOES, number, converged, cost, misfit, parameters, errors, shared, at_bound};
    int64_t found;
    if (decompose_clusters(&block, &clusters, &settings, 0, &echoes, &found) != WAVEFORMS) return 1;
    if (promise_echoes(&block, &clusters, &settings, promise)) return 1;
    for (int64_t i = 0, at = 0; i < WAVEFORMS; i++) {
        printf("%s %d: %d echoes, converged %d,", c->name, (int)i, (int)number[i], converged[i]);
        print_number(cost[i]); print_number(promise[i]);
        for (int64_t end = at + number[i]; at < end; at++) {
            printf("; %d", at_bound[at]); print_number(misfit[at]);
            for (int q = 0; q < 4; q++) { print_number(parameters[4 * at + q]); print_number(errors[4 * at + q]); }
            print_number(shared[2 * at]); print_number(shared[2 * at + 1]);
        }
        printf("\n");
    }
    return 0;
}

int main(void) {
    static Strip strip;
    static float value[ROWS], slope[ROWS];
    const double components[] = {0.12, 3, 1, -0.04, 5, 0.5};
    for (int i = 0; i < ROWS; i++) {
        double z = -8 + 16.0 * i / (ROWS - 1);
        value[i] = bell(z); slope[i] = -z * value[i];
    }
    const Pulse gaussian = {.kind = SUM_OF_GAUSSIANS, .power = 2}, sum = {SUM_OF_GAUSSIANS, 0, 2, 2, components, 0, 0, 0, NULL, NULL, 0};
    const Pulse skewed = {.kind = SKEWED, .skew = 0.11, .power = 2}, peaked = {.kind = POWER, .power = 1.4}, flat = {.kind = POWER, .power = 2.9};
    const Pulse read = {TABLE, 0, 2, 0, NULL, ROWS, -8, 16.0 / (ROWS - 1), value, slope, 0};
    const Pulse fixed = {.kind = LOG_NORMAL, .power = 2}, moving = {.kind = LOG_NORMAL, .power = 2, .from_waveform = 1};
    const double none = INFINITY;
    const Case cases[] = {
        {"gaussian", gaussian, none, 0, 0, 0, 1, 0, 0, 1, 0},
        {"clipped", gaussian, 120, 0, 0.2, 0, 2, 0, 0, 1, 0},
        {"weighted", gaussian, none, 0.05, 0.2, 0, 4, 0, 1, 1, 0},
        {"gaps", gaussian, 200, 0.02, 0.2, 0, 0, 1, 1, 1, 0},
        {"fixed number", gaussian, none, 0, 0, 0, 0, 0, 0, 0, 0},
        {"undamped", gaussian, none, 0, 0, 0, 1, 0, 0, 0, 1},
        {"free skews", gaussian, none, 0, 0.2, 0.1, 2, 0, 0, 1, 0},
        {"sum", sum, none, 0, 0.2, 0, 1, 0, 0, 1, 0},
        {"whitened", sum, none, 0, 0.2, 0, 1, 0, 0, 1, 0, 1},
        {"whitened, clipped, gaps", gaussian, 120, 0.02, 0.2, 0, 2, 1, 0, 1, 0, 1},
        {"skewed", skewed, none, 0.01, 0.2, 0, 1, 0, 0, 1, 0},
        {"skewed free", skewed, none, 0, 0.2, 0.1, 1, 1, 0, 1, 0},
        {"peaked", peaked, none, 0, 0.2, 0, 2, 0, 0, 1, 0},
        {"flat", flat, none, 0, 0.2, 0, 2, 0, 0, 1, 0},
        {"table", read, none, 0, 0.2, 0, 4, 0, 0, 1, 0},
        {"log-normal", fixed, none, 0, 0.2, 0, 0, 0, 0, 1, 0},
        {"log-normal of the waveform", moving, none, 0, 0, 0, 1, 0, 1, 0, 0},
        {"log-normal, skews asked for free", fixed, none, 0, 0, 0.1, 1, 0, 0, 1, 0},
    };
    make_strip(&strip);
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++)
        if (run_case(&cases[i], &strip)) { printf("%s: failed\n", cases[i].name); return 1; }
    return 0;
}
