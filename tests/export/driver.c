/* Drives the exported flight code from a pipe, for export-c-check and the tests.
 *
 * Requests and answers are packed binary, in the machine's own order. A request is a letter:
 *   T  readings, rolls                    -> status, trust of every node
 *   S  signature, attitude, reach         -> status, on nodes
 *   A  signature, attitude, error         -> the same of rdv_search_around
 *   O  signature, attitude                -> status, rdv_forest_score
 *   P  signature, attitude, reach         -> as S, of rdv_forest_search
 *   G  outlines, ends, rays               -> status, signature
 *   F  frame, camera, expected place      -> status, silhouette, points, status, signature
 *   B  n, then n times readings, rolls    -> nanoseconds of all trees, for each of them
 *   Q  n, then n times signature, attitude -> the same for rdv_search at RDV_REACH_RAD
 *   D  n, then n times signature, attitude -> the same for rdv_forest_score
 *   R  n, then n times signature, attitude -> the same for rdv_search_around with an error of 20°
 */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "rendezview_flight.h"

#define REPEATS 9
#define TWENTY_DEGREES 0.3490658503988659

static void take(void *to, size_t bytes)
{
    if ((bytes > 0u) && (fread(to, bytes, 1u, stdin) != 1u))
    {
        exit(2);
    }
}

static void give(const void *from, size_t bytes)
{
    if ((bytes > 0u) && (fwrite(from, bytes, 1u, stdout) != 1u))
    {
        exit(3);
    }
}

static void *room(size_t bytes)
{
    void *const memory = malloc((bytes > 0u) ? bytes : 1u);

    if (memory == NULL)
    {
        exit(4);
    }
    return memory;
}

static uint32_t number(void)
{
    uint32_t value = 0u;

    take(&value, sizeof(value));
    return value;
}

static void give_status(rdv_status status)
{
    const int32_t value = (int32_t)status;

    give(&value, sizeof(value));
}

static void trees(void)
{
    static rdv_f32 readings[RDV_BINS];
    static rdv_f64 rolls[RDV_NODES];
    static rdv_f64 trust[RDV_NODES];

    take(readings, sizeof(readings));
    take(rolls, sizeof(rolls));
    give_status(rdv_all_trees(readings, rolls, trust));
    give(trust, sizeof(trust));
}

static rdv_status search_by(int kind, const rdv_signature *signature, const rdv_f64 attitude[9],
                            rdv_f64 reach, rdv_on_nodes *found)
{
    rdv_status status = RDV_BAD_INPUT;

    if (kind == 'A')
    {
        status = rdv_search_around(signature, attitude, reach, found);
    }
    else if (kind == 'S')
    {
        status = rdv_search(signature, attitude, reach, found);
    }
#if (RDV_FOREST_TREES > 0u)
    else
    {
        status = rdv_forest_search(signature, attitude, reach, found);
    }
#endif
    return status;
}

static void score(void)
{
    static rdv_signature signature;
    rdv_f64 attitude[9];
    rdv_f64 answer = 0.0;

    take(signature.readings, sizeof(signature.readings));
    take(attitude, sizeof(attitude));
#if (RDV_FOREST_TREES > 0u)
    give_status(rdv_forest_score(&signature, attitude, &answer));
#else
    give_status(RDV_BAD_INPUT);
#endif
    give(&answer, sizeof(answer));
}

static void search(int kind)
{
    static rdv_signature signature;
    static rdv_on_nodes found;
    rdv_f64 attitude[9];
    rdv_f64 reach;
    rdv_status status;

    take(signature.readings, sizeof(signature.readings));
    take(attitude, sizeof(attitude));
    take(&reach, sizeof(reach));
    status = search_by(kind, &signature, attitude, reach, &found);
    give_status(status);
    if (status == RDV_OK)
    {
        give(&found.count, sizeof(found.count));
        give(found.nodes, found.count * sizeof(found.nodes[0]));
        give(found.trust, found.count * sizeof(found.trust[0]));
        give(found.weights, found.count * sizeof(found.weights[0]));
        give(&found.support, sizeof(found.support));
        give(found.direction, sizeof(found.direction));
    }
}

static void give_signature(rdv_status status, const rdv_signature *signature)
{
    give_status(status);
    if (status == RDV_OK)
    {
        give(signature->readings, sizeof(signature->readings));
        give(&signature->area_sr, sizeof(signature->area_sr));
        give(signature->centred_from_camera, sizeof(signature->centred_from_camera));
    }
}

static void signature_of(void)
{
    static rdv_signature signature;
    const uint32_t outlines = number();
    uint32_t *const ends = room(outlines * sizeof(uint32_t));
    rdv_point *rays;
    uint32_t count;

    take(ends, outlines * sizeof(uint32_t));
    count = number();
    rays = room(count * sizeof(rdv_point));
    take(rays, count * sizeof(rdv_point));
    give_signature(rdv_signature_of(rays, ends, outlines, &signature), &signature);
    free(rays);
    free(ends);
}

static void frame(void)
{
    static rdv_silhouette_found found;
    static rdv_signature signature;
    const uint32_t width = number();
    const uint32_t height = number();
    const uint32_t most_points = number();
    const uint32_t is_expected = number();
    uint8_t *const grey = room((size_t)width * height);
    uint8_t *const work = room(RDV_WORK_BYTES((size_t)width, height));
    rdv_point *const points = room(most_points * sizeof(rdv_point));
    rdv_point expected;
    rdv_pinhole camera;
    rdv_status status;

    take(&expected, sizeof(expected));
    take(&camera, sizeof(camera));
    take(grey, (size_t)width * height);
    status = rdv_silhouette(grey, width, height, &rdv_default_silhouette,
                            (is_expected != 0u) ? &expected : NULL, work, points, most_points,
                            &found);
    give_status(status);
    if (status == RDV_OK)
    {
        const uint32_t count = found.ends[found.outlines - 1u];
        const rdv_f64 levels[3] = {found.area_px, found.sky_grey, found.level_grey};
        const int32_t box[4] = {found.left, found.top, found.right, found.bottom};

        give(levels, sizeof(levels));
        give(box, sizeof(box));
        give(&found.outlines, sizeof(found.outlines));
        give(found.ends, found.outlines * sizeof(found.ends[0]));
        give(points, count * sizeof(rdv_point));
        rdv_rays(&camera, points, count);
        give_signature(rdv_signature_of(points, found.ends, found.outlines, &signature),
                       &signature);
    }
    free(points);
    free(work);
    free(grey);
}

static rdv_f64 now_ns(void)
{
    struct timespec time;

    (void)clock_gettime(CLOCK_MONOTONIC, &time);
    return (1e9 * (rdv_f64)time.tv_sec) + (rdv_f64)time.tv_nsec;
}

/* Every signature once in a round, so that no branch predictor has learned its path; of the
 * rounds the fastest answer, each signature for itself. */
static void speed(int kind)
{
    static rdv_on_nodes found;
    static rdv_f64 trust[RDV_NODES];
    const uint32_t n = number();
    const size_t numbers = (kind == 'B') ? RDV_NODES : 9u;
    rdv_signature *const signatures = room(n * sizeof(rdv_signature));
    rdv_f64 *const at = room(n * numbers * sizeof(rdv_f64));
    rdv_f64 *const best = room(n * sizeof(rdv_f64));
    uint32_t k;
    int repeat;

    for (k = 0u; k < n; k++)
    {
        take(signatures[k].readings, sizeof(signatures[k].readings));
        take(&at[k * numbers], numbers * sizeof(rdv_f64));
        best[k] = 1e18;
    }
    for (repeat = 0; repeat < REPEATS; repeat++)
    {
        for (k = 0u; k < n; k++)
        {
            const rdv_f64 start = now_ns();
            rdv_f64 spent;

            if (kind == 'B')
            {
                (void)rdv_all_trees(signatures[k].readings, &at[k * numbers], trust);
            }
#if (RDV_FOREST_TREES > 0u)
            else if (kind == 'D')
            {
                (void)rdv_forest_score(&signatures[k], &at[k * numbers], trust);
            }
#endif
            else if (kind == 'Q')
            {
                (void)rdv_search(&signatures[k], &at[k * numbers], RDV_REACH_RAD, &found);
            }
            else
            {
                (void)rdv_search_around(&signatures[k], &at[k * numbers], TWENTY_DEGREES, &found);
            }
            spent = now_ns() - start;
            best[k] = (spent < best[k]) ? spent : best[k];
        }
    }
    give(best, n * sizeof(rdv_f64));
    free(best);
    free(at);
    free(signatures);
}

int main(void)
{
    int request = getchar();

    while (request != EOF)
    {
        switch (request)
        {
        case 'T': trees(); break;
        case 'S':
        case 'A':
        case 'P': search(request); break;
        case 'O': score(); break;
        case 'G': signature_of(); break;
        case 'F': frame(); break;
        case 'B':
        case 'D':
        case 'Q':
        case 'R': speed(request); break;
        default: exit(5);
        }
        (void)fflush(stdout);
        request = getchar();
    }
    return 0;
}
