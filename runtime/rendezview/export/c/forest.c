/* Signature to scores: small trees for each node, whose mean is the log odds of the node. */
#include <math.h>
#include <stddef.h>

#include "rendezview_flight.h"

#if (RDV_FOREST_TREES > 0u)

#define PI 3.14159265358979323846
#define LEAF 255u

/* The readings in the bins and units of the forest. */
static void coarsen(const rdv_f32 readings[RDV_BINS], rdv_f32 coarse[RDV_FOREST_BINS])
{
    uint32_t k;
    uint32_t j;

    for (k = 0u; k < RDV_FOREST_BINS; k++)
    {
        rdv_f32 total = 0.0f;

        for (j = 0u; j < RDV_WINDOW; j++)
        {
            total += rdv_windows[k][j] * readings[(rdv_window_starts[k] + j) % RDV_BINS];
        }
        total /= RDV_FOREST_UNIT;
        coarse[k] = (total < 255.0f) ? total : 255.0f;
    }
}

/* Fill `rolled` with the readings as a camera at the roll of a node has them. */
static void roll_to(const rdv_f32 coarse[RDV_FOREST_BINS], const rdv_f64 view[9],
                    const rdv_f64 node[6], rdv_f32 rolled[RDV_FOREST_BINS])
{
    rdv_f64 c = 0.0;
    rdv_f64 s = 0.0;
    rdv_f64 shift;
    rdv_f32 part;
    uint32_t j;
    uint32_t k;

    for (k = 0u; k < 3u; k++)
    {
        c += (view[k] * node[k]) + (view[3u + k] * node[3u + k]);
        s += (view[3u + k] * node[k]) - (view[k] * node[3u + k]);
    }
    shift = (-atan2(s, c) * (rdv_f64)RDV_FOREST_BINS) / (2.0 * PI);
    part = (rdv_f32)(shift - floor(shift));
    j = (uint32_t)(floor(shift) + (rdv_f64)RDV_FOREST_BINS) % RDV_FOREST_BINS;
    for (k = 0u; k < RDV_FOREST_BINS; k++)
    {
        const uint32_t next = (j + 1u) % RDV_FOREST_BINS;

        rolled[k] = ((1.0f - part) * coarse[j]) + (part * coarse[next]);
        j = next;
    }
}

/* Mean of a node's trees, in steps of RDV_ODDS_UNIT. An entry is, from its lowest bit: the bin (8
 * bits), the threshold or the odds of a leaf (8), how far ahead the right child is (16). */
static rdv_f64 ask(const rdv_f32 rolled[RDV_FOREST_BINS], uint32_t node)
{
    int32_t total = 0;
    uint32_t tree;
    uint32_t level;

    for (tree = 0u; tree < RDV_FOREST_TREES; tree++)
    {
        uint32_t at = rdv_forest_roots[node][tree];
        uint32_t entry = rdv_forest[at];
        int32_t odds;

        for (level = 0u; (level < RDV_FOREST_DEPTH) && ((entry & 255u) != LEAF); level++)
        {
            at += (rolled[entry & 255u] <= (rdv_f32)((entry >> 8) & 255u)) ? 1u : (entry >> 16);
            entry = rdv_forest[at];
        }
        odds = (int32_t)((entry >> 8) & 255u);
        total += (odds > 127) ? (odds - 256) : odds;
    }
    return (rdv_f64)total / (rdv_f64)RDV_FOREST_TREES;
}

/* The nodes near a view and the odds of each, in steps of RDV_ODDS_UNIT. */
static rdv_status ask_near(const rdv_signature *signature, const rdv_f64 *view, rdv_f64 cosine,
                           uint16_t nodes[RDV_NODES], rdv_f64 odds[RDV_NODES], uint32_t *count)
{
    rdv_status status = RDV_BAD_INPUT;
    rdv_f32 coarse[RDV_FOREST_BINS];
    rdv_f32 rolled[RDV_FOREST_BINS];
    uint32_t k;

    *count = 0u;
    if ((signature != NULL) && (view != NULL))
    {
        status = rdv_nodes_near(view, cosine, nodes, count);
        coarsen(signature->readings, coarse);
    }
    for (k = 0u; k < *count; k++)
    {
        roll_to(coarse, view, rdv_attitudes[nodes[k]], rolled);
        odds[k] = ask(rolled, nodes[k]);
    }
    return status;
}

rdv_status rdv_forest_score(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                            rdv_f64 *score)
{
    rdv_status status = RDV_BAD_INPUT;
    uint16_t nodes[RDV_NODES];
    rdv_f64 odds[RDV_NODES];
    uint32_t count;
    uint32_t k;

    if (score != NULL)
    {
        status = ask_near(signature, centred_from_target, RDV_FOREST_COSINE, nodes, odds, &count);
    }
    if (status == RDV_OK)
    {
        rdv_f64 total = 0.0;

        for (k = 0u; k < count; k++)
        {
            total += odds[k];
        }
        *score = ((count > 0u) ? (total / (rdv_f64)count) : -127.0) * RDV_ODDS_UNIT;
    }
    return status;
}

rdv_status rdv_forest_search(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                             rdv_f64 reach_rad, rdv_on_nodes *found)
{
    rdv_status status = RDV_BAD_INPUT;
    uint16_t nodes[RDV_NODES];
    rdv_f64 odds[RDV_NODES];
    uint32_t count;
    uint32_t k;

    if ((found != NULL) && (reach_rad >= 0.0))
    {
        status = ask_near(signature, centred_from_target, cos(fmin(reach_rad, PI)) - 1e-12, nodes,
                          odds, &count);
    }
    if (status == RDV_OK)
    {
        found->count = 0u;
        found->support = 0.0;
        for (k = 0u; k < count; k++)
        {
            const rdv_f64 log_odds = odds[k] * RDV_ODDS_UNIT;

            if (log_odds > RDV_LEAST_ODDS)
            {
                found->nodes[found->count] = nodes[k];
                found->trust[found->count] =
                    1.0 / (1.0 + exp(-RDV_ODDS_STEEPNESS * (log_odds - RDV_EVEN_ODDS)));
                found->count++;
            }
        }
        if (found->count > 0u)
        {
            rdv_agree(found);
        }
        else
        {
            status = RDV_UNRECOGNIZED;
        }
    }
    return status;
}

#endif
