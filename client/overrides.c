// Builds the bodies of requests about scenes. A scene file is passed on as it is, so that the
// daemon judges what the user wrote and not what our parser made of it.
#include "client/overrides.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/terminal.h"

#define SCENE_MAX_BYTES (64u << 20)

int overrides_add(cJSON *patch, const char *word) {
    const char *equals = strchr(word, '=');
    if (!equals || equals == word) {
        terminal_error("%s: must be key=value, such as cell=0.5 or materials.water.density=1000",
                       word);
        return -1;
    }
    char *keys = strndup(word, (size_t)(equals - word)), *rest = keys, *key;
    cJSON *value = cJSON_ParseWithOpts(equals + 1, NULL, 1);
    if (!value)
        value = cJSON_CreateString(equals + 1);
    while (keys && value && (key = strsep(&rest, "."))) {
        if (!*key) {
            terminal_error("%s: the key has an empty part", word);
            free(keys);
            cJSON_Delete(value);
            return -1;
        }
        cJSON *next = cJSON_GetObjectItemCaseSensitive(patch, key);
        if (!rest) {
            if (next)
                cJSON_ReplaceItemInObjectCaseSensitive(patch, key, value);
            else
                cJSON_AddItemToObject(patch, key, value);
        } else if (!cJSON_IsObject(next)) {
            cJSON_DeleteItemFromObjectCaseSensitive(patch, key);
            next = cJSON_AddObjectToObject(patch, key);
        }
        patch = next;
    }
    free(keys);
    return 0;
}

static char *read_file(const char *path) {
    FILE *file = fopen(path, "rb");
    char *text = NULL;
    size_t n = 0, capacity = 0;
    if (!file) {
        terminal_error("%s: %s", path, strerror(errno));
        return NULL;
    }
    for (;;) {
        if (n + 1 >= capacity) {
            capacity = capacity ? 2 * capacity : 65536;
            char *grown = capacity <= 2 * SCENE_MAX_BYTES ? realloc(text, capacity) : NULL;
            if (!grown) {
                terminal_error("%s: too large for a scene", path);
                break;
            }
            text = grown;
        }
        const size_t got = fread(text + n, 1, capacity - n - 1, file);
        n += got;
        if (got == 0) {
            if (ferror(file)) {
                terminal_error("%s: %s", path, strerror(errno));
                break;
            }
            fclose(file);
            text[n] = '\0';
            if (strlen(text) == n)
                return text;
            terminal_error("%s: is no JSON: it holds zero bytes", path);
            free(text);
            return NULL;
        }
    }
    fclose(file);
    free(text);
    return NULL;
}

// Says where the text stops being JSON, which also keeps it from breaking out of the request around
// it.
static int check_json(const char *path, const char *text) {
    const char *end = NULL;
    cJSON *parsed = cJSON_ParseWithOpts(text, &end, 1);
    if (parsed) {
        cJSON_Delete(parsed);
        return 0;
    }
    int line = 1, column = 1;
    for (const char *c = text; end && c < end && *c; c++) {
        column = *c == '\n' ? 1 : column + 1;
        line += *c == '\n';
    }
    terminal_error("%s:%d:%d: is no JSON from here on", path, line, column);
    return -1;
}

char *overrides_scene(const char *word) {
    const size_t n = strlen(word);
    if (strchr(word, '/') || (n > 5 && strcmp(word + n - 5, ".json") == 0)) {
        char *text = read_file(word);
        if (text && check_json(word, text) != 0) {
            free(text);
            return NULL;
        }
        return text;
    }
    cJSON *name = cJSON_CreateString(word);
    char *text = cJSON_PrintUnformatted(name);
    cJSON_Delete(name);
    return text;
}

char *overrides_body(const char *scene, const cJSON *patch, const char *rest) {
    char *overrides = cJSON_PrintUnformatted(patch), *body = NULL;
    if (!overrides || asprintf(&body, "{\"scene\":%s,\"overrides\":%s%s%s}", scene, overrides,
                               *rest ? "," : "", rest) < 0) {
        terminal_error("out of memory");
        body = NULL;
    }
    free(overrides);
    return body;
}
