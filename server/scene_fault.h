// Faults of a scene: the place as a JSON pointer, what was expected, and what was perhaps meant.
#pragma once
#include "server/json.h"

// A place in the scene, kept on the C stack: a key of `parent`, or an index where `key` is NULL.
// The scene itself has neither. Its pointer's text is built only when there is a fault.
struct scene_cursor {
    const struct scene_cursor *parent;
    const char *key;
    size_t index;
};

// As faults_add, with the cursor's pointer.
void scene_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                 const char *expected, const char *actual, const char *format, ...)
    __attribute__((format(printf, 6, 7)));
// "must be EXPECTED, got ..." with the value in a few words.
void scene_value_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                       const char *expected, const cJSON *json);

// As scene_fault, with the value in a few words as what came.
void scene_given_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                       const char *expected, const cJSON *json, const char *format, ...)
    __attribute__((format(printf, 6, 7)));

// The candidate nearest to a word that is unknown, if one is near. Start with `word` alone.
struct scene_suggestion {
    const char *word, *best;
    int distance;
};
void scene_suggest(struct scene_suggestion *suggestion, const char *candidate);
// "WHAT "word"; did you mean "best"?", or what was expected.
void scene_unknown_fault(struct faults *faults, const struct scene_cursor *at, const char *code,
                         const char *expected, const char *what,
                         const struct scene_suggestion *suggestion);

// Copies text of at most `size` - 1 bytes, cut between characters.
void scene_clip(char *out, size_t size, const char *text);
