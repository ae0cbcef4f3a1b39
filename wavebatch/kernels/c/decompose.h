/* A cluster from its candidates to its echoes: fit, test, add, accept, docs/algorithms.md 2.3, 4.2. */

static const double UNRESOLVED = 0.25;         /* distance, in its errors, below which two echoes are one. At 1, a quarter
                                                  of the pairs 1.5 widths apart with an amplitude ratio of 0.5 is lost */
static const double FAINT = 1;                 /* height in the window, in noise, at which a fit found no echo */
static const double MOST_SKEW = 0.6;           /* the half after the peak is then twice as wide as the half before it */
static const double MOST_AMPLITUDE = 1e12;     /* above any count of 32 bits, also of the peak of a clipped echo */
static const double BREATH = 1.1;              /* widths of the second try, over or under that of the pulse */
static const double AS_PULSE = 0.02;           /* spread of widths about that of the pulse in a second try after echoes were missed */
static const double MISSED = 9;                /* falls that one more echo needs: so much is left where echoes were missed. It is
                                                  three times what noise and the pulse's misfit explain, as an amplitude */
static const double FAINT_START = 0.25;        /* share of its amplitude with which an echo starts beside others that stay */
static const double PROVEN = 2;                /* errors of an amplitude whose echo chi2 proves: simulated pairs scatter by
                                                  .35 to .65 of it, however much chi2 rises without the echo */
static const double STEADY = 0.01;             /* misfit below which no pulse is known: from shot to shot those of real sensors
                                                  change by .4 to 1.2 % of the amplitude */
static const double REACHES = 4;               /* widths from an echo at which its shape is nothing */
static const double BROADEST = 100;            /* widths of the pulse that one echo may have in place of others, as tables do */
static const double ROOT_PI = 1.7724538509055161;

/* Amplitudes from 0, times within 3 samples of the window, widths and skews as set. */
static Limits limits_of(const Settings *s, const Window *w) {
    double first = s->pulse.kind == LOG_NORMAL ? fmax(-3, origin_of(s, w) + LEAST_AWAY) : -3;
    return (Limits){{0, first, s->width_low, -MOST_SKEW}, {MOST_AMPLITUDE, w->n + 2, s->width_high, MOST_SKEW}};
}

/* Takes out the echo with the least height in the window, if that is no more than noise; returns whether it did. It
   would block growth: no larger fit with it is resolved. */
static int leave_out_faint(Work *work) {
    const Fit *fit = &work->fit;
    const int64_t k = fit->k;
    double least = INFINITY;
    int64_t lowest = 0;
    if (k < 2) return 0;
    for (int64_t j = 0; j < k; j++) {
        double time = fit->parameters[k + j], out = at_least(at_least(-time, time - (work->window.n - 1)), 0) / fit->parameters[2 * k + j];
        double height = fit->parameters[j] * exp_lanes(ALL(-0.5 * out * out))[0];
        if (height < least) { least = height; lowest = j; }
    }
    if (least > FAINT * work->window.std) return 0;
    double *next = work->next.parameters;
    for (int64_t i = 0; i < 3 * k; i++)
        if (i % k != lowest) *next++ = fit->parameters[i];
    work->next.k = k - 1;
    return 1;
}

/* Whether no two neighbours are closer than their errors allow (H1), and all echoes have an amplitude. */
static int is_resolved(const Solution *s) {
    const double *time = s->parameters + s->k, *error = s->errors + s->k;
    for (int64_t i = 0; i < s->k; i++) {
        int64_t after = -1;
        if (!(s->parameters[i] > 0)) return 0;
        for (int64_t j = 0; j < s->k; j++)
            if ((time[j] > time[i] || (time[j] == time[i] && j > i)) && (after < 0 || time[j] < time[after])) after = j;
        if (after >= 0 && !(time[after] - time[i] > UNRESOLVED * sqrt(error[i] * error[i] + error[after] * error[after]))) return 0;
    }
    return 1;
}

/* Whether fits of a window may grow: not where it is wider than the most echoes side by side, each as wide as an echo can
   be. No more echoes explain such a run, and trying them takes ten times as long, for runs of up to 65,535 samples. */
static int may_grow(const Settings *s, const Window *w) {
    return s->grow && w->n <= s->max_echoes * 2 * HERMITE_REACH * s->width_high;
}

/* Energy of Gaussians in that of the noise. */
static double energy_of(int64_t k, const double *parameters, double std) {
    double energy = 0;
    for (int64_t j = 0; j < k; j++) energy += parameters[j] * parameters[j] * parameters[2 * k + j];
    return ROOT_PI * energy / (std * std);
}

/* Fall of chi2 that one more echo needs: the acceptance, and what a misfit of the pulse model may explain (R3). */
static double least_fall(const Settings *s, int64_t k, const double *parameters, double std) {
    return s->acceptance + s->misfit * s->misfit * energy_of(k, parameters, std);
}

static void exchange(Solution *one, Solution *other) {
    Solution kept = *one;
    *one = *other; *other = kept;
}

/* Whether a fit leaves so much more than noise and the pulse's misfit explain that it must have missed echoes. */
static int misses_echoes(const Settings *s, const Work *work, double cost, double fall) {
    return s->thorough && cost - work->window.used > MISSED * fall;
}

/* The best fit and a faint new echo where it was proposed: from there chi2 falls. The step of all echoes at once may end
   far off, where the pulse is narrow beside the samples. */
static void start_beside(Work *work) {
    const int64_t k = work->next.k;
    for (int64_t q = 0; q < 3; q++) {
        memcpy(work->fit.parameters + q * k, work->best.parameters + q * (k - 1), (k - 1) * sizeof(double));
        work->fit.parameters[q * k + k - 1] = work->next.parameters[q * k + k - 1] * (q == 0 ? FAINT_START : 1);
    }
}

/* Echoes from the starts in work->next, into work->best; 0, or -1 where there is no memory.

   A larger fit is kept if it lowers chi2 below the target and its echoes are resolved; else the one before it stands.
   The number of rounds is bounded, because each echo that is left out must have been there or been added. */
static int grow_window(const Settings *s, const Limits *limits, const Prior *widths, Work *work) {
    const Prior none = {0};
    double target = INFINITY;
    int missed = 0;
    int64_t rounds = 4 * (work->next.k + s->max_echoes);
    work->best.k = 0;
    for (; rounds > 0; rounds--) {
        const int64_t k = work->next.k;
        memcpy(work->fit.parameters, work->next.parameters, 3 * k * sizeof(double));
        const Prior *prior = k > 1 || widths->both ? widths : &none;
        fit_window(k, 3, s, limits, prior, target, work);
        if (missed && k == work->best.k + 1 && (work->fit.hopeless || !(work->fit.cost < target))) {
            start_beside(work);
            fit_window(k, 3, s, limits, prior, target, work);
        }
        if (work->fit.hopeless || (target < INFINITY && !(work->fit.cost < target))) return 0;
        if (leave_out_faint(work)) continue;
        describe_fit(s, limits, work, &work->trial);
        if (target < INFINITY && !is_resolved(&work->trial)) return 0;
        exchange(&work->trial, &work->best);
        const double fall = least_fall(s, k, work->fit.parameters, work->window.std);
        missed = misses_echoes(s, work, work->fit.cost, fall);
        if (!(work->fit.converged || missed) || !may_grow(s, &work->window) || k >= s->max_echoes) return 0;
        if (s->whitened) whitened_moments(s, work, &work->fit);
        else hermite_moments(work, &work->fit);
        if (!(s->whitened ? is_whitened_misfit : is_misfit)(s, work, &work->fit)) return 0;
        if (!reserve(work, k + 1, work->window.vectors)) return -1;
        double promise = propose_echo(s, work, &work->fit, limits, &work->next);
        if (!(promise > 0.5 * fall)) return 0;
        target = work->fit.cost - fall;
    }
    return 0;
}

/* Puts candidates first .. first + k - 1 into the starts, in samples of the window; false without memory. */
static int set_starts(const Clusters *c, int64_t cluster, Work *work) {
    const int64_t k = c->number[cluster], first = c->first[cluster], n = c->high[cluster] - c->low[cluster];
    if (!reserve(work, k, VECTORS(n))) return 0;
    work->next.k = k;
    for (int64_t j = 0; j < k; j++) {
        work->next.parameters[j] = c->amplitude[first + j];
        work->next.parameters[k + j] = c->time[first + j] - c->low[cluster];
        work->next.parameters[2 * k + j] = c->width[first + j];
    }
    return 1;
}

/* The echoes of a cluster, into work->best; 0, or -1 where there is no memory.

   An echo too broad that bridges two, with its neighbours shifted to make up for it, is a minimum that no further echo
   leaves. So where more is left than noise and the pulse's misfit explain, there is a second try: it grows with echoes
   of the pulse's width, which bridge nothing, and then frees their widths. The better one stands. Where echoes must have
   been missed, widths are taken as known meanwhile: with pulses as narrow as the samples, three free parameters of each
   echo leave nothing of a new one between two. */
static int decompose_window(const Settings *s, const Clusters *clusters, int64_t cluster, Work *work) {
    const Limits limits = limits_of(s, &work->window);
    const Prior free = {s->width_ref, s->prior_spread, 0, 0, 0}, known = {s->width_ref, AS_PULSE * s->width_ref, 0, 0, 1};
    Limits narrow = limits;
    if (!set_starts(clusters, cluster, work) || grow_window(s, &limits, &free, work) < 0) return -1;
    const int64_t k = work->best.k;
    const double cost = work->best.cost, fall = least_fall(s, k, work->best.parameters, work->window.std);
    if (!may_grow(s, &work->window) || cost - work->window.used < fall) return 0;
    exchange(&work->best, &work->spare);
    narrow.low[2] = at_least(limits.low[2], s->width_ref / BREATH);
    narrow.high[2] = at_most(limits.high[2], s->width_ref * BREATH);
    if (!set_starts(clusters, cluster, work) || grow_window(s, &narrow, misses_echoes(s, work, cost, fall) ? &known : &free, work) < 0) return -1;
    work->next.k = work->best.k;
    memcpy(work->next.parameters, work->best.parameters, 3 * work->best.k * sizeof(double));
    if (grow_window(s, &limits, &free, work) < 0) return -1;
    if (!(work->best.cost + fall * (work->best.k - k) < cost)) exchange(&work->best, &work->spare);
    return 0;
}

/* One echo in place of all of the best fit, where that explains the samples as well and is broader than echoes may be: on
   a steep slope a wide beam makes one broad echo, and several that share it are places where nothing is. */
static void join_broad(const Settings *s, Work *work) {
    const Solution *best = &work->best;
    const int64_t k = best->k;
    const double *a = best->parameters, *t = a + k, *w = t + k;
    const Prior none = {0};
    Limits limits = limits_of(s, &work->window);
    double area = 0, time = 0, square = 0;
    for (int64_t j = 0; j < k; j++) { area += a[j] * w[j]; time += a[j] * w[j] * t[j]; }
    if (!(area > 0)) return;
    time /= area;
    for (int64_t j = 0; j < k; j++) square += a[j] * w[j] * (w[j] * w[j] + (t[j] - time) * (t[j] - time));
    const double width = sqrt(square / area);
    if (width < s->width_high) return;
    limits.high[2] = at_least(s->width_high, BROADEST * s->width_ref);
    work->fit.parameters[0] = area / width; work->fit.parameters[1] = time; work->fit.parameters[2] = width;
    /* The pulse's misfit may explain one fall, not one for each: several proven echoes would fall together. */
    const double target = best->cost + (k - 2) * s->acceptance + least_fall(s, k, a, work->window.std);
    fit_window(1, 3, s, &limits, &none, target, work);
    const int is_broad = work->fit.parameters[2] >= s->width_high; /* else it is one of them, and the others are gone */
    if (is_broad && !work->fit.hopeless && work->fit.converged && work->fit.cost < target) describe_fit(s, &limits, work, &work->best);
}

/* Errors of the best fit once more, with what is known of its amplitudes. */
static void renew_errors(const Settings *s, const Prior *prior, Work *work) {
    Solution *best = &work->best;
    const int64_t k = best->k, per = 3;
    work->fit.prior = *prior;
    memcpy(work->fit.parameters, best->parameters, per * k * sizeof(double));
    evaluate_rows(k, per, s, work, best->parameters);
    find_products(per * k + 1, work, work->fit.gram);
    add_prior(k, per, prior, work->window.std, best->parameters, work->fit.gram);
    FOR_EACH_NUMBER(find_errors, work, best);
}

/* Takes out echoes of the best fit that are not known: amplitudes below `known` errors without which chi2 rises by less
   than a new echo must lower it.

   Errors of close echoes are those of a parabola, and the valley of chi2 is none: where they say that an amplitude may
   as well be 0, the fit without the echo says how far chi2 rises on the way there. Beside strong echoes it must be more
   than what their pulse makes with another shape: one echo of it looks like two. An echo without which it rises enough
   has an amplitude of PROVEN errors at least, and those that share its light have less to share. Where one is left out,
   the time of each other may be wrong by as much as it moves. */
static void leave_out_unknown(const Settings *s, Work *work) {
    const Limits limits = limits_of(s, &work->window);
    const Prior prior = {s->width_ref, s->prior_spread, 0, 0, 0}, none = {0};
    const double noise = work->window.std;
    Solution *best = &work->best;
    const int64_t all = best->k;
    double *before = work->h3; /* times as they were */
    memcpy(before, best->parameters + all, all * sizeof(double));
    for (int64_t k = best->k, asked = 0; k > 1 && asked < k; k = best->k) {
        int64_t least = -1, left = 0;
        for (int64_t j = 0; j < k; j++) {
            const double *a = best->parameters, *e = best->errors;
            if (!(work->known[j] > 0) && (least < 0 || a[j] * e[least] < a[least] * e[j])) least = j;
        }
        const double amplitude = best->parameters[least], error = best->errors[least];
        if (amplitude >= s->known * error) break;
        for (int64_t i = 0; i < 3 * k; i++)
            if (i % k != least) work->fit.parameters[left++] = best->parameters[i];
        fit_window(k - 1, 3, s, &limits, k > 2 ? &prior : &none, INFINITY, work);
        const double *fewer = work->fit.parameters, proof = work->fit.cost - best->cost, place = best->parameters[k + least];
        double beside = 0;
        for (int64_t j = 0; j < k - 1; j++) {
            const double one[3] = {fewer[j], fewer[k - 1 + j], fewer[2 * (k - 1) + j]};
            if (fabs(one[1] - place) < REACHES * one[2]) beside += energy_of(1, one, noise);
        }
        if (!(amplitude > 0) || proof < least_fall(s, k - 1, fewer, noise) || proof < STEADY * STEADY * beside) {
            memset(work->known, 0, k * sizeof(double));
            memmove(before + least, before + least + 1, (k - 1 - least) * sizeof(double));
            describe_fit(s, &limits, work, best);
            asked = 0;
        } else {
            double more = noise * noise * (PROVEN * PROVEN / (amplitude * amplitude) - 1 / (error * error));
            work->known[least] = at_least(more, 1e-300); /* above 0: it was asked */
            renew_errors(s, &prior, work);
            asked++;
        }
    }
    memset(work->known, 0, all * sizeof(double));
    for (int64_t j = 0; j < best->k && best->k < all; j++) {
        double *error = best->errors + best->k + j, moved = best->parameters[best->k + j] - before[j];
        *error = sqrt(*error * *error + moved * moved);
    }
}

/* The same echoes with a skew of their own each, 1.2. */
static void free_skews(const Settings *s, Work *work) {
    const int64_t k = work->best.k;
    const Limits limits = limits_of(s, &work->window);
    const Prior prior = {0, 0, s->skew_mean, s->skew_spread, 0};
    memcpy(work->fit.parameters, work->best.parameters, 3 * k * sizeof(double));
    for (int64_t j = 0; j < k; j++) work->fit.parameters[3 * k + j] = s->pulse.kind == SKEWED ? s->pulse.skew : 0;
    fit_window(k, 4, s, &limits, &prior, INFINITY, work);
    describe_fit(s, &limits, work, &work->best);
}

/* The skews of log-normals follow from their widths and times. */
static void tied_skews(double origin, Solution *s) {
    const int64_t k = s->k;
    for (int64_t j = 0; j < k; j++) {
        double away = fmax(s->parameters[k + j] - origin, LEAST_AWAY), skew = s->parameters[2 * k + j] / away;
        double by_width = s->errors[2 * k + j] / away, by_time = skew * s->errors[k + j] / away;
        s->parameters[3 * k + j] = skew;
        s->errors[3 * k + j] = sqrt(by_width * by_width + by_time * by_time);
    }
    s->per = 4;
}

static void write_echoes(const Solution *s, int64_t begin, int64_t cluster, int64_t at, const Echoes *out) {
    out->number[cluster] = s->k; out->converged[cluster] = s->converged;
    out->cost[cluster] = s->cost;
    for (int64_t j = 0; j < s->k; j++) {
        double *parameters = out->parameters + 4 * (at + j), *errors = out->errors + 4 * (at + j), *shared = out->shared + 2 * (at + j);
        for (int64_t q = 0; q < 4; q++) {
            parameters[q] = q < s->per ? s->parameters[q * s->k + j] : 0;
            errors[q] = q < s->per ? s->errors[q * s->k + j] : 0;
        }
        parameters[1] += begin;
        shared[0] = s->shared[j]; shared[1] = s->shared[s->k + j];
        out->misfit[at + j] = s->misfit[j];
        out->at_bound[at + j] = s->at_bound[j];
    }
}

/* Echoes of clusters `from` and after it, one after the other, until their room ends. Returns the first cluster that is
   not done, and in `found` the number of echoes; -1 where there is no memory. */
EXPORT int64_t decompose_clusters(const Block *block, const Clusters *clusters, const Settings *s, int64_t from, Echoes *out, int64_t *found) {
    Work work = {0};
    int64_t i = make_taps(&work, s, block->length) ? from : -1;
    *found = 0;
    for (; i >= 0 && i < clusters->n; i++) {
        if (!reserve(&work, clusters->number[i], VECTORS(clusters->high[i] - clusters->low[i]))) { i = -1; break; }
        cut_window(block, s, clusters->waveform[i], clusters->low[i], clusters->high[i], &work.window);
        if (s->whitened && s->grow) find_new_energy(&work);
        if (decompose_window(s, clusters, i, &work) < 0) { i = -1; break; }
        if (s->thorough && work.best.k > 1 && !(s->skew_spread > 0)) join_broad(s, &work);
        if (s->known > 0) leave_out_unknown(s, &work);
        if (s->skew_spread > 0 && s->pulse.kind != LOG_NORMAL) free_skews(s, &work);
        if (s->pulse.kind == LOG_NORMAL) tied_skews(origin_of(s, &work.window), &work.best);
        if (*found + work.best.k > out->room) break;
        write_echoes(&work.best, clusters->low[i], i, *found, out);
        *found += work.best.k;
    }
    free_work(&work);
    return i;
}

/* Fall of chi2 that one more echo promises beside the candidates of each cluster, which are the fit; -1 without memory. */
EXPORT int64_t promise_echoes(const Block *block, const Clusters *clusters, const Settings *s, double *promise) {
    Work work = {0};
    int64_t done = make_taps(&work, s, block->length);
    for (int64_t i = 0; i < clusters->n && done; i++) {
        const int64_t k = clusters->number[i];
        done = set_starts(clusters, i, &work) && reserve(&work, k + 1, VECTORS(clusters->high[i] - clusters->low[i]));
        if (!done) break;
        cut_window(block, s, clusters->waveform[i], clusters->low[i], clusters->high[i], &work.window);
        Limits limits = limits_of(s, &work.window);
        memcpy(work.fit.parameters, work.next.parameters, 3 * k * sizeof(double));
        work.fit.k = k; work.fit.per = 3;
        evaluate_rows(k, 3, s, &work, work.fit.parameters);
        find_products(3 * k + 1, &work, work.fit.gram);
        take_level_off(&work.window, 1, work.rows + 3 * k * work.window.vectors);
        if (s->whitened) { find_new_energy(&work); whitened_moments(s, &work, &work.fit); }
        else hermite_moments(&work, &work.fit);
        promise[i] = propose_echo(s, &work, &work.fit, &limits, &work.next);
    }
    free_work(&work);
    return done ? 0 : -1;
}
