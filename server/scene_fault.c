// Builds faults: pointers, short renderings of what came, and "did you mean".
#include "server/scene_fault.h"

#include <ctype.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// ---- Faults -------------------------------------------------------------------------------------

// The root has neither parent nor token.
static void pointer_text(const struct scene_cursor *at, char *out, size_t n) {
    if (!at->parent)
        return;
    pointer_text(at->parent, out, n);
    char index[24];
    snprintf(index, sizeof index, "%zu", at->index);
    json_pointer_append(out, n, at->key ? at->key : index);
}

static void fault_with(struct faults *faults, const struct scene_cursor *at, const char *code,
                       const char *expected, const char *actual, const char *format,
                       va_list arguments) {
    char pointer[1024] = "", detail[1024], *whole = NULL;
    pointer_text(at, pointer, sizeof pointer);
    if (vasprintf(&whole, format, arguments) < 0)
        whole = NULL;
    scene_clip(detail, sizeof detail, whole ? whole : ""); // what came may be of any length
    free(whole);
    faults_add(faults, pointer, code, expected, actual, "%s", detail);
}

void scene_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                 const char *expected, const char *actual, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    fault_with(faults, at, code, expected, actual, format, arguments);
    va_end(arguments);
}

void scene_clip(char *out, size_t size, const char *text) {
    size_t n = strlen(text);
    if (n > size - 1) {
        n = size - 4;
        while (n > 0 && ((unsigned char)text[n] & 0xC0) == 0x80)
            n--;
        snprintf(out, size, "%.*s...", (int)n, text);
    } else {
        memcpy(out, text, n + 1);
    }
}

// What came, in a few words.
static void actual_text(const cJSON *json, char out[80]) {
    if (cJSON_IsArray(json)) {
        snprintf(out, 80, "an array of %d", cJSON_GetArraySize(json));
    } else if (cJSON_IsObject(json)) {
        snprintf(out, 80, "an object");
    } else {
        char *text = json_print(json, false);
        scene_clip(out, 80, text ? text : "");
        free(text);
    }
}

void scene_value_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                       const char *expected, const cJSON *json) {
    char actual[80];
    actual_text(json, actual);
    scene_fault(faults, at, code, expected, actual, "must be %s, got %s", expected, actual);
}

void scene_given_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                       const char *expected, const cJSON *json, const char *format, ...) {
    char actual[80];
    va_list arguments;
    actual_text(json, actual);
    va_start(arguments, format);
    fault_with(faults, at, code, expected, actual, format, arguments);
    va_end(arguments);
}

// ---- Did you mean -------------------------------------------------------------------------------

#define WORD_MAX 64

// Edits (insert, delete, replace, swap of neighbours) from a to b, letter case aside.
static int edit_distance(const char *a, const char *b) {
    int rows[3][WORD_MAX + 1];
    int n = (int)strlen(a), m = (int)strlen(b);
    int *before = rows[0], *above = rows[1], *row = rows[2];
    for (int j = 0; j <= m; j++)
        above[j] = j;
    for (int i = 1; i <= n; i++) {
        row[0] = i;
        for (int j = 1; j <= m; j++) {
            int same = tolower((unsigned char)a[i - 1]) == tolower((unsigned char)b[j - 1]);
            int best = above[j - 1] + !same;
            best = above[j] + 1 < best ? above[j] + 1 : best;
            best = row[j - 1] + 1 < best ? row[j - 1] + 1 : best;
            if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] &&
                before[j - 2] + 1 < best)
                best = before[j - 2] + 1;
            row[j] = best;
        }
        int *free_row = before;
        before = above;
        above = row;
        row = free_row;
    }
    return above[m];
}

void scene_suggest(struct scene_suggestion *s, const char *candidate) {
    size_t n = strlen(s->word);
    if (n > WORD_MAX || strlen(candidate) > WORD_MAX)
        return;
    int limit = n < 4 ? 1 : n < 7 ? 2 : 3;
    int distance = edit_distance(s->word, candidate);
    if (distance <= limit && (!s->best || distance < s->distance)) {
        s->best = candidate;
        s->distance = distance;
    }
}

void scene_unknown_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                         const char *expected, const char *what, const struct scene_suggestion *s) {
    char word[80];
    scene_clip(word, sizeof word, s->word);
    if (s->best)
        scene_fault(faults, at, code, expected, word, "%s \"%s\"; did you mean \"%s\"?", what, word,
                    s->best);
    else
        scene_fault(faults, at, code, expected, word, "%s \"%s\"; expected %s", what, word,
                    expected);
}
