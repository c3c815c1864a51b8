// Strict JSON in, faults out: what cJSON alone would let through is refused here before it parses.
#pragma once
#include <cjson/cJSON.h>
#include <stdbool.h>
#include <stddef.h>

#define JSON_COUNTED 9007199254740992.0 // 2^53: where doubles, and so numbers here, cease to count

// One fault of a request body; the API's error objects (docs/api.md) have the same members.
struct fault {
    char *pointer;  // RFC 6901, owned
    char *code;     // "unknown_key", "type", "range", "required", ...: owned
    char *expected; // owned, may be NULL
    char *actual;   // owned, may be NULL
    char *detail;   // one sentence, owned
};
// All faults of one body, in the order found. Zero-initialise; faults_free empties it. Holds at
// most FAULTS_MAX; the number found beyond that is in `more`.
#define FAULTS_MAX 100
struct faults {
    struct fault *items;
    size_t count, capacity, more;
};
void faults_add(struct faults *faults, const char *pointer, const char *code, const char *expected,
                const char *actual, const char *format, ...) __attribute__((format(printf, 6, 7)));
void faults_free(struct faults *faults);
// The array of error objects of an RFC 9457 problem.
cJSON *faults_json(const struct faults *faults);

#define JSON_MAX_DEPTH 64

// Parses UTF-8 text of `n` bytes as RFC 8259 JSON. Refuses duplicate keys, trailing text, numbers
// that are no finite double, leading zeros, raw control characters, bad UTF-8, \u0000 and lone
// surrogates, and nesting deeper than JSON_MAX_DEPTH. NULL with one fault added, whose detail names
// line and column.
cJSON *json_parse(const char *text, size_t n, struct faults *faults);

// RFC 7396: a new value, `target` with `patch` applied; neither is changed. `target` may be NULL.
cJSON *json_merge_patch(const cJSON *target, const cJSON *patch);

// Case-sensitive member, NULL when absent.
cJSON *json_member(const cJSON *object, const char *key);
// Appends /token with ~ and / escaped (RFC 6901) to the pointer in `out` (capacity `n`).
void json_pointer_append(char *out, size_t n, const char *token);
// A new number object that prints with the fewest digits that read back to the same double; null
// when the value is not finite.
cJSON *json_number(double value);
// XXH3-64 of a text, in hexadecimal.
#define JSON_DIGEST 17
void json_digest(const char *text, char *out);
// The text of a value, freed with free: every number with the fewest digits that read back to the
// same double, which cJSON's own printing does not promise.
char *json_print(const cJSON *json, bool indented);
// The same in one line, of a value that goes: no copy of it is made.
char *json_print_away(cJSON *json);
