// A reader of Accept headers: media-range *( ";" parameter ) [ ";" "q" "=" qvalue ], with commas
// between.
#include "server/accept.h"

#include <stdbool.h>
#include <string.h>
#include <strings.h>

#define QUALITY_ONE 1000 // a qvalue has at most three digits behind the point

enum precision { TAKES_NOTHING, TAKES_ALL, TAKES_TYPE, TAKES_SUBTYPE, TAKES_PARAMETERS };
struct range {
    const char *name; // "text/csv", "text/*", "*/*"
    size_t length;
    int quality; // thousandths
    bool has_parameters;
};

static const char *skip_blanks(const char *at) {
    return at + strspn(at, " \t");
}

// 0, 1, 0.5, 0.333, 1.000; -1 for anything else.
static int quality_of(const char *text, size_t n) {
    int value = 0, unit = QUALITY_ONE;
    if (n == 0 || n > 5 || (text[0] != '0' && text[0] != '1') || (n > 1 && text[1] != '.'))
        return -1;
    for (size_t k = 0; k < n; k++) {
        if (k == 1)
            continue;
        if (text[k] < '0' || text[k] > '9')
            return -1;
        value += unit * (text[k] - '0');
        unit /= 10;
    }
    return value <= QUALITY_ONE ? value : -1;
}

// Past "name=value" with the value a token or a quoted string; NULL when it is none.
static const char *read_parameter(const char *at, struct range *out) {
    size_t name = strcspn(at, "=,; \t\"");
    if (name == 0 || at[name] != '=')
        return NULL;
    const char *value = at + name + 1, *end = value;
    if (*value == '"') {
        for (end++; *end != '"'; end++) {
            if (*end == '\\')
                end++;
            if (*end == '\0')
                return NULL;
        }
        end++;
    } else {
        end += strcspn(value, ",; \t\"");
    }
    if (name != 1 || (at[0] != 'q' && at[0] != 'Q'))
        out->has_parameters = true;
    else if ((out->quality = quality_of(value, (size_t)(end - value))) < 0)
        return NULL;
    return end;
}

// Whether what begins at *at is a range; moves to the comma behind it, or the end.
static bool read_range(const char **at, struct range *out) {
    const char *c = *at;
    *out = (struct range){.name = c, .length = strcspn(c, ",; \t\""), .quality = QUALITY_ONE};
    c = skip_blanks(c + out->length);
    while (c != NULL && *c == ';') {
        c = skip_blanks(c + 1);
        if (*c == ';' || *c == ',' || *c == '\0')
            continue; // an empty parameter is none
        c = read_parameter(c, out);
        if (c != NULL)
            c = skip_blanks(c);
    }
    bool valid = c != NULL && (*c == ',' || *c == '\0') &&
                 memchr(out->name, '/', out->length) != NULL;
    if (c == NULL || !valid)
        c = *at;
    *at = c + strcspn(c, ",");
    return valid;
}

static enum precision takes(const struct range *range, const char *type) {
    size_t n = strlen(type), stem = (size_t)(strchr(type, '/') + 1 - type);
    if (range->length == n && strncasecmp(range->name, type, n) == 0)
        return range->has_parameters ? TAKES_PARAMETERS : TAKES_SUBTYPE;
    if (range->length == stem + 1 && range->name[stem] == '*' &&
        strncasecmp(range->name, type, stem) == 0)
        return TAKES_TYPE;
    return range->length == 3 && memcmp(range->name, "*/*", 3) == 0 ? TAKES_ALL : TAKES_NOTHING;
}

int accept_best(const char *header, const char *const *types, size_t n) {
    int best = 0, best_quality = -1;
    size_t best_place = 0;
    enum precision best_precision = TAKES_NOTHING;
    bool refused = n > 0;
    for (size_t k = 0; k < n && header != NULL; k++) {
        enum precision precision = TAKES_NOTHING;
        int quality = -1;
        size_t place = 0, count = 0;
        struct range range;
        for (const char *at = header; *(at += strspn(at, ", \t")) != '\0'; count++) {
            if (!read_range(&at, &range))
                continue;
            enum precision here = takes(&range, types[k]);
            if (here <= precision)
                continue;
            precision = here;
            quality = range.quality;
            place = count;
        }
        refused = refused && quality == 0;
        if (quality <= 0)
            continue;
        bool better = quality != best_quality       ? quality > best_quality
                      : precision != best_precision ? precision > best_precision
                                                    : place < best_place;
        if (better) {
            best = (int)k;
            best_quality = quality;
            best_precision = precision;
            best_place = place;
        }
    }
    return header != NULL && refused ? -1 : best;
}
