// A temporal collection of Polyvertex grids. Each grid cuts its rows out of the arrays of all
// frames, so nothing is stored twice.
//
// ParaView has two XDMF readers that agree on no form of a cut: "XDMF Reader" (version 2) knows the
// item type HyperSlab with two children, in any case of letters; "Xdmf3 Reader" knows the item type
// only as it is spelled there, fails on it, and takes `file:path|starts:strides:counts:extents` as
// the text of a plain item. An item that is both, spelled Hyperslab, is read by each in its own way
// (ParaView 5.11: test_record_xdmf_opens_in_paraview). Both want the connectivity of the vertices
// spelled out.
#include "client/xdmf.h"

#include <errno.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

static void put_escaped(FILE *out, const char *text) {
    for (; *text; text++)
        switch (*text) {
        case '&':
            fputs("&amp;", out);
            break;
        case '<':
            fputs("&lt;", out);
            break;
        case '>':
            fputs("&gt;", out);
            break;
        case '"':
            fputs("&quot;", out);
            break;
        default:
            fputc(*text, out);
        }
}

struct slab {
    const char *h5_name, *place;
    const char *type; // "Float", "UInt" or "Int"
    int precision;
    uint64_t row, count, rows; // of the frame; of all frames
    size_t columns;            // 1: one-dimensional
};

static void put_place(FILE *out, const struct slab *s) {
    put_escaped(out, s->h5_name);
    fputc(':', out);
    put_escaped(out, s->place);
}

static void put_slab(FILE *out, const struct slab *s) {
    const unsigned long long row = s->row, count = s->count, rows = s->rows;
    char columns[32] = "", zero[4] = "", one[4] = "";
    if (s->columns > 1) {
        snprintf(columns, sizeof columns, " %zu", s->columns);
        snprintf(zero, sizeof zero, " 0");
        snprintf(one, sizeof one, " 1");
    }
    fprintf(out,
            "<DataItem ItemType=\"Hyperslab\" Dimensions=\"%llu%s\" NumberType=\"%s\" "
            "Precision=\"%d\" Format=\"HDF\">",
            count, columns, s->type, s->precision);
    put_place(out, s);
    fprintf(out, "|%llu%s:1%s:%llu%s:%llu%s", row, zero, one, count, columns, rows, columns);
    fprintf(out, "<DataItem Dimensions=\"3 %d\" Format=\"XML\">%llu%s 1%s %llu%s</DataItem>",
            s->columns > 1 ? 2 : 1, row, zero, one, count, columns);
    fprintf(out,
            "<DataItem Dimensions=\"%llu%s\" NumberType=\"%s\" Precision=\"%d\" Format=\"HDF\">",
            rows, columns, s->type, s->precision);
    put_place(out, s);
    fputs("</DataItem></DataItem>", out);
}

static void put_frame(FILE *out, const char *h5_name, const struct store_plan *plan, uint64_t row,
                      uint64_t count) {
    const struct slab vertices = {.h5_name = h5_name,
                                  .place = "/VTKHDF/Vertices/Connectivity",
                                  .type = "Int",
                                  .precision = 8,
                                  .count = count,
                                  .rows = plan->most_particles,
                                  .columns = 1};
    fprintf(
        out,
        "<Topology TopologyType=\"Polyvertex\" NumberOfElements=\"%llu\" NodesPerElement=\"1\">",
        (unsigned long long)count);
    put_slab(out, &vertices);
    fputs("</Topology>\n", out);
    for (size_t k = 0; k < plan->n_fields; k++) {
        const struct store_field *f = &plan->fields[k];
        const bool position = strcmp(f->name, "position") == 0;
        char place[96];
        snprintf(place, sizeof place, position ? "/VTKHDF/Points" : "/VTKHDF/PointData/%s",
                 f->name);
        const struct slab slab = {.h5_name = h5_name,
                                  .place = place,
                                  .type = f->dtype[1] == 'f' ? "Float" : "UInt",
                                  .precision = f->dtype[2] - '0',
                                  .row = row,
                                  .count = count,
                                  .rows = plan->n_rows,
                                  .columns = f->file_components};
        if (position)
            fputs("<Geometry GeometryType=\"XYZ\">", out);
        else
            fprintf(out, "<Attribute Name=\"%s\" AttributeType=\"%s\" Center=\"Node\">", f->name,
                    f->rank == 1   ? "Scalar"
                    : f->rank == 2 ? "Vector"
                                   : "Tensor");
        put_slab(out, &slab);
        fputs(position ? "</Geometry>\n" : "</Attribute>\n", out);
    }
}

int xdmf_write(const char *path, const char *h5_name, const struct store_plan *plan,
               const double *times, const uint64_t *rows, const uint64_t *counts, char *why,
               size_t why_bytes) {
    FILE *out = fopen(path, "w");
    if (!out) {
        snprintf(why, why_bytes, "%s: %s", path, strerror(errno));
        return -1;
    }
    fputs("<?xml version=\"1.0\" ?>\n<Xdmf Version=\"3.0\"><Domain>\n"
          "<Grid Name=\"particles\" GridType=\"Collection\" CollectionType=\"Temporal\">\n",
          out);
    for (size_t i = 0; i < plan->n_frames; i++) {
        fprintf(out, "<Grid Name=\"frame %zu\" GridType=\"Uniform\"><Time Value=\"%.17g\"/>\n", i,
                times[i]);
        put_frame(out, h5_name, plan, rows[i], counts[i]);
        fputs("</Grid>\n", out);
    }
    fputs("</Grid>\n</Domain></Xdmf>\n", out);
    const bool good = !ferror(out) && fflush(out) == 0 && fsync(fileno(out)) == 0;
    const int error = errno;
    if (fclose(out) != 0 || !good) {
        snprintf(why, why_bytes, "%s: %s", path, strerror(good ? errno : error));
        return -1;
    }
    return 0;
}
