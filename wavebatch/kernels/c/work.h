/* Memory of one call. It grows to the largest window and cluster that it meets, and is freed at the end of the call. */

typedef struct { /* samples of one cluster, padded to whole vectors */
    int64_t begin, n, vectors, used;           /* used: recorded samples */
    double std;
    lanes *y, *x;                              /* signal; position, OUTSIDE where there is no sample */
    lanes *clipped, *weight;                   /* 1 where clipped, -1 at the floor; noise without signal over noise */
    lanes *filter;                             /* where noise is whitened: coefficients of samples i, i - 1, i - 2; (3, vectors) */
    lanes *level;                              /* what an error of the level looks like: rows lose their share of it */
    double level_share;                        /* its square; 0 where the level is known */
    int any_clipped, is_weighted, is_whitened;
} Window;

typedef struct { double width, spread, skew, skew_spread; int both; } Prior; /* spread 0: none; both: of wider echoes too */

typedef struct { /* k echoes with `per` parameters each: k amplitudes, then k times, widths, skews */
    int64_t k, per;
    int converged, hopeless;
    double cost;                               /* chi2 and prior */
    Prior prior;
    double *parameters, *gram;                 /* gram: products of the rows, the last row is the residual */
} Fit;

typedef struct { /* a fit with its errors; laid out as `parameters` */
    int64_t k, per;
    int converged;
    double cost;
    double *misfit, *parameters, *errors, *shared;
    uint8_t *at_bound;
} Solution;

typedef struct {
    int64_t room, vectors;                     /* echoes and vectors for which there is memory */
    Window window;
    lanes *rows, *about, *padded, *energy;     /* of the fit; correlated with a new pulse */
    lanes *coarse;                             /* a row summed over strides */
    lanes *back, *new_energy;                  /* where noise is whitened: a row filtered back; energy of a new pulse */
    Fit fit, next;
    Solution trial, best, spare;
    double *kept, *products, *matrix, *pivot, *step, *column, *along, *h3, *h4; /* along: products of the rows and the level */
    double *known;                             /* of amplitudes: one over variance, in noise, beside what the fit says */
    uint8_t *frozen;
    float *taps, *edges;                       /* of a new pulse; its energy, whitened, from each end of a window */
    int64_t reach, stride;                     /* of the taps of a new pulse; samples from tap to tap */
    int has_edges;
} Work;

/* Enlarges a buffer and keeps what is in it; false where there is no memory. */
static int enlarge(void *buffer, size_t bytes) {
    void *larger = realloc(*(void **)buffer, bytes);
    if (!larger) return 0;
    *(void **)buffer = larger;
    return 1;
}

/* Memory for k echoes in a window of so many vectors; what is there stays. */
static int reserve(Work *w, int64_t k, int64_t vectors) {
    if (k <= w->room && vectors <= w->vectors) return 1;
    k = k > w->room ? k + 2 : w->room;
    vectors = vectors > w->vectors ? vectors + 2 : w->vectors;
    size_t row = vectors * sizeof(lanes), p = 4 * k + 1, number = sizeof(double);
    size_t padded = row + 2 * (VECTORS(w->reach) + 4) * sizeof(lanes);
    int good = enlarge(&w->window.y, row) && enlarge(&w->window.x, row) && enlarge(&w->window.clipped, row)
        && enlarge(&w->window.weight, row) && enlarge(&w->window.filter, 3 * row) && enlarge(&w->window.level, row) && enlarge(&w->back, row)
        && enlarge(&w->new_energy, row) && enlarge(&w->rows, p * row) && enlarge(&w->about, p * row)
        && enlarge(&w->padded, padded) && enlarge(&w->coarse, row) && enlarge(&w->energy, row)
        && enlarge(&w->fit.parameters, p * number) && enlarge(&w->fit.gram, p * p * number) && enlarge(&w->next.parameters, p * number)
        && enlarge(&w->kept, p * number) && enlarge(&w->products, p * p * number) && enlarge(&w->matrix, p * p * number)
        && enlarge(&w->pivot, p * number) && enlarge(&w->step, p * number) && enlarge(&w->column, p * p * number)
        && enlarge(&w->along, p * number)
        && enlarge(&w->h3, p * number) && enlarge(&w->h4, p * number) && enlarge(&w->known, p * number) && enlarge(&w->frozen, p);
    Solution *all[] = {&w->trial, &w->best, &w->spare};
    for (int i = 0; i < 3 && good; i++)
        good = enlarge(&all[i]->misfit, p * number) && enlarge(&all[i]->parameters, p * number)
            && enlarge(&all[i]->errors, p * number) && enlarge(&all[i]->shared, p * number) && enlarge(&all[i]->at_bound, p);
    if (good) { w->room = k; w->vectors = vectors; memset(w->known, 0, p * number); }
    return good;
}

static void free_work(Work *w) {
    void *all[] = {w->window.y, w->window.x, w->window.clipped, w->window.weight, w->window.filter, w->window.level, w->back, w->new_energy, w->rows, w->about, w->padded, w->coarse, w->energy,
        w->fit.parameters, w->fit.gram, w->next.parameters, w->kept, w->products, w->matrix, w->pivot, w->step, w->column, w->along, w->h3, w->h4,
        w->known, w->frozen, w->taps, w->edges, w->trial.parameters, w->trial.errors, w->trial.shared, w->trial.at_bound, w->best.parameters,
        w->best.errors, w->best.shared, w->best.at_bound, w->spare.parameters, w->spare.errors, w->spare.shared, w->spare.at_bound,
        w->trial.misfit, w->best.misfit, w->spare.misfit};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++) free(all[i]);
}
