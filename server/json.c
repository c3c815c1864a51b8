// JSON as the daemon accepts and writes it. The reader is our own, because cJSON's lets through
// what RFC 8259 forbids or leaves open (duplicate keys, trailing text, "01", 1e999, raw control
// characters, bad UTF-8), cuts strings at \u0000 and numbers at 63 characters; the tree it builds
// is cJSON's.
#include "server/json.h"

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <xxhash.h>

// ---- Faults -------------------------------------------------------------------------------------

static char *copy_text(const char *text) {
    return text ? strdup(text) : NULL;
}

void faults_add(struct faults *faults, const char *pointer, const char *code, const char *expected,
                const char *actual, const char *format, ...) {
    if (faults->count == FAULTS_MAX) {
        faults->more++;
        return;
    }
    if (faults->count == faults->capacity) {
        size_t capacity = faults->capacity ? 2 * faults->capacity : 8;
        struct fault *items = realloc(faults->items, capacity * sizeof *items);
        if (!items) {
            faults->more++; // still counted, so that the caller sees a failure
            return;
        }
        faults->items = items;
        faults->capacity = capacity;
    }
    va_list arguments;
    va_start(arguments, format);
    char *detail = NULL;
    if (vasprintf(&detail, format, arguments) < 0)
        detail = NULL;
    va_end(arguments);
    faults->items[faults->count++] = (struct fault){
        .pointer = copy_text(pointer),
        .code = copy_text(code),
        .expected = copy_text(expected),
        .actual = copy_text(actual),
        .detail = detail,
    };
}

void faults_free(struct faults *faults) {
    for (size_t i = 0; i < faults->count; i++) {
        struct fault *fault = &faults->items[i];
        free(fault->pointer);
        free(fault->code);
        free(fault->expected);
        free(fault->actual);
        free(fault->detail);
    }
    free(faults->items);
    *faults = (struct faults){0};
}

static void add_text(cJSON *object, const char *key, const char *text) {
    cJSON_AddItemToObject(object, key, text ? cJSON_CreateString(text) : cJSON_CreateNull());
}

cJSON *faults_json(const struct faults *faults) {
    cJSON *array = cJSON_CreateArray();
    for (size_t i = 0; i < faults->count; i++) {
        const struct fault *fault = &faults->items[i];
        cJSON *object = cJSON_CreateObject();
        add_text(object, "pointer", fault->pointer);
        add_text(object, "code", fault->code);
        add_text(object, "expected", fault->expected);
        add_text(object, "actual", fault->actual);
        add_text(object, "detail", fault->detail);
        cJSON_AddItemToArray(array, object);
    }
    return array;
}

// ---- Reader -------------------------------------------------------------------------------------

// A key of an object that is still open, with its place in the text.
struct open_key {
    const char *key; // borrowed from the tree
    size_t offset;
};
struct reader {
    const char *text;
    size_t n, at;
    int depth;
    struct faults *faults;
    struct open_key *keys; // a stack: those of the innermost object are on top
    size_t n_keys, keys_capacity;
    char *buffer; // one decoded string
    size_t length, capacity;
};

// Adds the one fault, with the line and column (in characters, from 1) of `offset`. Returns false.
static bool refuse(struct reader *r, size_t offset, const char *what) {
    size_t line = 1, column = 1;
    for (size_t i = 0; i < offset && i < r->n; i++) {
        if (r->text[i] == '\n') {
            line++;
            column = 1;
        } else if ((r->text[i] & 0xC0) != 0x80) {
            column++;
        }
    }
    faults_add(r->faults, "", "json", NULL, NULL, "line %zu, column %zu: %s", line, column, what);
    return false;
}

static cJSON *fail(struct reader *r, size_t offset, const char *what) {
    refuse(r, offset, what);
    return NULL;
}

static void skip_space(struct reader *r) {
    while (r->at < r->n && (r->text[r->at] == ' ' || r->text[r->at] == '\t' ||
                            r->text[r->at] == '\n' || r->text[r->at] == '\r'))
        r->at++;
}

// The byte at the reader's place; -1 at the end (0 is a byte like any other).
static int peek(const struct reader *r) {
    return r->at < r->n ? (unsigned char)r->text[r->at] : -1;
}

static bool buffer_put(struct reader *r, const char *bytes, size_t n) {
    if (r->length + n + 1 > r->capacity) {
        size_t capacity = 2 * (r->length + n + 1);
        char *buffer = realloc(r->buffer, capacity);
        if (!buffer)
            return false;
        r->buffer = buffer;
        r->capacity = capacity;
    }
    memcpy(r->buffer + r->length, bytes, n);
    r->length += n;
    r->buffer[r->length] = 0;
    return true;
}

// Bytes of the well-formed UTF-8 sequence that starts at s, 0 when it is none: table 3-7 of the
// Unicode standard, which rules out overlong forms, surrogates and what lies above U+10FFFF.
static size_t utf8_sequence(const unsigned char *s, size_t n) {
    size_t bytes = s[0] < 0x80   ? 1
                   : s[0] < 0xC2 ? 0
                   : s[0] < 0xE0 ? 2
                   : s[0] < 0xF0 ? 3
                   : s[0] < 0xF5 ? 4
                                 : 0;
    if (bytes == 0 || bytes > n)
        return 0;
    for (size_t i = 1; i < bytes; i++)
        if ((s[i] & 0xC0) != 0x80)
            return 0;
    if ((s[0] == 0xE0 && s[1] < 0xA0) || (s[0] == 0xED && s[1] > 0x9F) ||
        (s[0] == 0xF0 && s[1] < 0x90) || (s[0] == 0xF4 && s[1] > 0x8F))
        return 0;
    return bytes;
}

// Four hexadecimal digits at the reader's place, or -1.
static long hex4(struct reader *r) {
    long value = 0;
    if (r->n - r->at < 4)
        return -1;
    for (int i = 0; i < 4; i++) {
        char c = r->text[r->at + (size_t)i];
        int digit = c >= '0' && c <= '9'   ? c - '0'
                    : c >= 'a' && c <= 'f' ? c - 'a' + 10
                    : c >= 'A' && c <= 'F' ? c - 'A' + 10
                                           : -1;
        if (digit < 0)
            return -1;
        value = 16 * value + digit;
    }
    r->at += 4;
    return value;
}

static bool buffer_put_code_point(struct reader *r, unsigned long code) {
    char out[4];
    size_t n;
    if (code < 0x80) {
        out[0] = (char)code;
        n = 1;
    } else if (code < 0x800) {
        out[0] = (char)(0xC0 | code >> 6);
        out[1] = (char)(0x80 | (code & 0x3F));
        n = 2;
    } else if (code < 0x10000) {
        out[0] = (char)(0xE0 | code >> 12);
        out[1] = (char)(0x80 | (code >> 6 & 0x3F));
        out[2] = (char)(0x80 | (code & 0x3F));
        n = 3;
    } else {
        out[0] = (char)(0xF0 | code >> 18);
        out[1] = (char)(0x80 | (code >> 12 & 0x3F));
        out[2] = (char)(0x80 | (code >> 6 & 0x3F));
        out[3] = (char)(0x80 | (code & 0x3F));
        n = 4;
    }
    return buffer_put(r, out, n);
}

// After a backslash at `start`: decodes one escape into the buffer.
static bool read_escape(struct reader *r, size_t start) {
    static const char plain[] = "\"\\/bfnrt", meaning[] = "\"\\/\b\f\n\r\t";
    int c = peek(r);
    r->at++;
    const char *found = c > 0 ? strchr(plain, c) : NULL;
    if (found)
        return buffer_put(r, &meaning[found - plain], 1) || refuse(r, start, "out of memory");
    if (c != 'u')
        return refuse(r, start, "an escape that JSON does not have");
    long code = hex4(r);
    if (code < 0)
        return refuse(r, start, "\\u needs four hexadecimal digits");
    if (code == 0)
        return refuse(r, start, "\\u0000 is not accepted in text");
    if (code >= 0xDC00 && code <= 0xDFFF)
        return refuse(r, start, "a lone low surrogate");
    if (code >= 0xD800 && code <= 0xDBFF) {
        long low = -1;
        if (r->n - r->at >= 2 && r->text[r->at] == '\\' && r->text[r->at + 1] == 'u') {
            r->at += 2;
            low = hex4(r);
        }
        if (low < 0xDC00 || low > 0xDFFF)
            return refuse(r, start, "a lone high surrogate");
        code = 0x10000 + (code - 0xD800) * 0x400 + (low - 0xDC00);
    }
    return buffer_put_code_point(r, (unsigned long)code) || refuse(r, start, "out of memory");
}

// Decodes the string at the reader's place (at its quote) into the buffer.
static bool read_string(struct reader *r) {
    size_t start = r->at++;
    r->length = 0;
    if (!buffer_put(r, "", 0))
        return refuse(r, start, "out of memory");
    for (;;) {
        int c = peek(r);
        size_t here = r->at;
        if (c < 0)
            return refuse(r, start, "a string without an end");
        if (c == '"') {
            r->at++;
            return true;
        }
        if (c == '\\') {
            r->at++;
            if (!read_escape(r, here))
                return false;
            continue;
        }
        if (c < 0x20)
            return refuse(r, here, "a control character in a string; write it as an escape");
        size_t bytes = utf8_sequence((const unsigned char *)r->text + here, r->n - here);
        if (!bytes)
            return refuse(r, here, "text that is not UTF-8");
        if (!buffer_put(r, r->text + here, bytes))
            return refuse(r, here, "out of memory");
        r->at += bytes;
    }
}

static bool skip_digits(struct reader *r) {
    size_t start = r->at;
    while (peek(r) >= '0' && peek(r) <= '9')
        r->at++;
    return r->at > start;
}

static cJSON *read_number(struct reader *r) {
    size_t start = r->at;
    if (peek(r) == '-')
        r->at++;
    if (peek(r) == '0') {
        r->at++;
        if (peek(r) >= '0' && peek(r) <= '9')
            return fail(r, start, "a number with a leading zero");
    } else if (!skip_digits(r)) {
        return fail(r, start, "a value was expected here");
    }
    if (peek(r) == '.') {
        r->at++;
        if (!skip_digits(r))
            return fail(r, start, "a number needs digits after its point");
    }
    if (peek(r) == 'e' || peek(r) == 'E') {
        r->at++;
        if (peek(r) == '+' || peek(r) == '-')
            r->at++;
        if (!skip_digits(r))
            return fail(r, start, "a number needs digits in its exponent");
    }
    r->length = 0; // strtod wants an end, which the text may lack
    if (!buffer_put(r, r->text + start, r->at - start))
        return fail(r, start, "out of memory");
    double value = strtod(r->buffer, NULL); // the daemon stays in the "C" locale
    if (!isfinite(value))
        return fail(r, start, "a number too large for double precision");
    cJSON *number = cJSON_CreateNumber(value);
    return number ? number : fail(r, start, "out of memory");
}

static cJSON *read_word(struct reader *r) {
    static const struct {
        const char *word;
        cJSON *(*create)(void);
    } words[] = {
        {"true", cJSON_CreateTrue}, {"false", cJSON_CreateFalse}, {"null", cJSON_CreateNull}};
    for (size_t i = 0; i < sizeof words / sizeof *words; i++) {
        size_t n = strlen(words[i].word);
        if (r->n - r->at >= n && memcmp(r->text + r->at, words[i].word, n) == 0) {
            r->at += n;
            return words[i].create();
        }
    }
    return fail(r, r->at, r->at == r->n ? "the text ends too early" : "a value was expected here");
}

static int compare_open_keys(const void *a, const void *b) {
    const struct open_key *left = a, *right = b;
    int order = strcmp(left->key, right->key);
    return order ? order : (left->offset > right->offset) - (left->offset < right->offset);
}

// Sorted rather than hashed, so that no choice of keys makes it quadratic. The first repetition in
// the text is the one reported.
static bool keys_differ(struct reader *r, size_t base) {
    size_t n = r->n_keys - base, first = SIZE_MAX;
    if (n < 2)
        return true;
    struct open_key *keys = r->keys + base;
    qsort(keys, n, sizeof *keys, compare_open_keys);
    for (size_t i = 1; i < n; i++)
        if (strcmp(keys[i - 1].key, keys[i].key) == 0 && keys[i].offset < first)
            first = keys[i].offset;
    return first == SIZE_MAX || refuse(r, first, "a key that the object already has");
}

static bool push_key(struct reader *r, const char *key, size_t offset) {
    if (r->n_keys == r->keys_capacity) {
        size_t capacity = r->keys_capacity ? 2 * r->keys_capacity : 64;
        struct open_key *keys = realloc(r->keys, capacity * sizeof *keys);
        if (!keys)
            return refuse(r, offset, "out of memory");
        r->keys = keys;
        r->keys_capacity = capacity;
    }
    r->keys[r->n_keys++] = (struct open_key){.key = key, .offset = offset};
    return true;
}

static cJSON *read_value(struct reader *r);

// One `"key": value` into the object.
static bool read_member(struct reader *r, cJSON *object) {
    size_t offset = r->at;
    if (peek(r) != '"')
        return refuse(r, r->at, "a key in quotes was expected here");
    if (!read_string(r))
        return false;
    char *key = cJSON_malloc(r->length + 1);
    if (!key)
        return refuse(r, offset, "out of memory");
    memcpy(key, r->buffer, r->length + 1);
    skip_space(r);
    cJSON *value = NULL;
    if (peek(r) == ':') {
        r->at++;
        skip_space(r);
        value = read_value(r);
    } else {
        fail(r, r->at, "a colon was expected here");
    }
    if (!value) {
        cJSON_free(key);
        return false;
    }
    value->string = key; // as cJSON_AddItemToObject would, without another copy
    cJSON_AddItemToArray(object, value);
    return push_key(r, key, offset);
}

static cJSON *read_container(struct reader *r) {
    bool is_object = peek(r) == '{';
    int close = is_object ? '}' : ']';
    size_t base = r->n_keys;
    cJSON *container = is_object ? cJSON_CreateObject() : cJSON_CreateArray();
    if (!container)
        return fail(r, r->at, "out of memory");
    r->at++;
    skip_space(r);
    bool good = true;
    if (peek(r) == close) {
        r->at++;
        return container;
    }
    for (;;) {
        if (is_object) {
            good = read_member(r, container);
        } else {
            cJSON *item = read_value(r);
            good = item && cJSON_AddItemToArray(container, item);
        }
        if (!good)
            break;
        skip_space(r);
        int c = peek(r);
        if (c != ',' && c != close) {
            fail(r, r->at,
                 c < 0       ? "the text ends too early"
                 : is_object ? "a comma or } was expected here"
                             : "a comma or ] was expected here");
            good = false;
            break;
        }
        r->at++;
        if (c == close)
            break;
        skip_space(r);
    }
    good = good && keys_differ(r, base);
    r->n_keys = base;
    if (good)
        return container;
    cJSON_Delete(container);
    return NULL;
}

static cJSON *read_value(struct reader *r) {
    int c = peek(r);
    size_t start = r->at;
    cJSON *value = NULL;
    if (c == '{' || c == '[') {
        if (r->depth == JSON_MAX_DEPTH)
            return fail(r, start, "nested deeper than 64 levels");
        r->depth++;
        value = read_container(r);
        r->depth--;
        return value;
    }
    if (c == '"') {
        if (!read_string(r))
            return NULL;
        value = cJSON_CreateString(r->buffer);
    } else if (c == '-' || (c >= '0' && c <= '9')) {
        return read_number(r);
    } else {
        return read_word(r);
    }
    return value ? value : fail(r, start, "out of memory");
}

cJSON *json_parse(const char *text, size_t n, struct faults *faults) {
    struct reader r = {.text = text, .n = n, .faults = faults};
    skip_space(&r);
    cJSON *value = NULL;
    if (n >= 3 && memcmp(text, "\xEF\xBB\xBF", 3) == 0)
        fail(&r, 0, "a byte order mark; JSON is sent without one");
    else if (r.at == n)
        fail(&r, r.at, "no JSON value at all");
    else
        value = read_value(&r);
    if (value) {
        skip_space(&r);
        if (r.at != n) {
            cJSON_Delete(value);
            value = fail(&r, r.at, "text after the end of the value");
        }
    }
    free(r.keys);
    free(r.buffer);
    return value;
}

// ---- Merge patch --------------------------------------------------------------------------------

// The members of an object sorted by key, so that a patch of many keys costs no quadratic search.
struct member_index {
    cJSON **members;
    size_t n;
};

static int compare_members(const void *a, const void *b) {
    return strcmp((*(cJSON *const *)a)->string, (*(cJSON *const *)b)->string);
}

static int compare_key_member(const void *key, const void *member) {
    return strcmp(key, (*(cJSON *const *)member)->string);
}

static bool index_members(cJSON *object, struct member_index *index) {
    index->n = (size_t)cJSON_GetArraySize(object);
    index->members = malloc((index->n ? index->n : 1) * sizeof *index->members);
    if (!index->members)
        return false;
    size_t i = 0;
    for (cJSON *member = object->child; member; member = member->next)
        index->members[i++] = member;
    qsort(index->members, index->n, sizeof *index->members, compare_members);
    return true;
}

static bool merge_into(cJSON *target, const cJSON *patch);

// A copy of a patch's member as it stands where the target has no such object.
static cJSON *fresh_member(const cJSON *patch) {
    if (!cJSON_IsObject(patch))
        return cJSON_Duplicate(patch, true);
    cJSON *object = cJSON_CreateObject();
    if (object && !merge_into(object, patch)) {
        cJSON_Delete(object);
        return NULL;
    }
    if (object && patch->string && !(object->string = strdup(patch->string))) {
        cJSON_Delete(object);
        return NULL;
    }
    return object;
}

// RFC 7396, section 2, for a target that is an object; in place. False when memory runs out.
static bool merge_into(cJSON *target, const cJSON *patch) {
    struct member_index index;
    if (!index_members(target, &index))
        return false;
    cJSON *removed = cJSON_CreateArray(); // kept to the end: the index still reads their keys
    bool good = removed != NULL;
    for (const cJSON *change = patch->child; change && good; change = change->next) {
        cJSON **found = bsearch(change->string, index.members, index.n, sizeof *index.members,
                                compare_key_member);
        if (cJSON_IsNull(change)) {
            if (found)
                cJSON_AddItemToArray(removed, cJSON_DetachItemViaPointer(target, *found));
        } else if (found && cJSON_IsObject(*found) && cJSON_IsObject(change)) {
            good = merge_into(*found, change);
        } else {
            cJSON *value = fresh_member(change);
            good = value != NULL;
            if (good && found) {
                cJSON_ReplaceItemViaPointer(target, *found, value);
                *found = value;
            } else if (good) {
                cJSON_AddItemToArray(target, value); // it carries its key
            }
        }
    }
    free(index.members);
    cJSON_Delete(removed);
    return good;
}

cJSON *json_merge_patch(const cJSON *target, const cJSON *patch) {
    if (!cJSON_IsObject(patch))
        return cJSON_Duplicate(patch, true);
    cJSON *merged = cJSON_IsObject(target) ? cJSON_Duplicate(target, true) : cJSON_CreateObject();
    if (merged && !merge_into(merged, patch)) {
        cJSON_Delete(merged);
        return NULL;
    }
    return merged;
}

// ---- Look-up and output -------------------------------------------------------------------------

cJSON *json_member(const cJSON *object, const char *key) {
    if (!cJSON_IsObject(object))
        return NULL;
    for (cJSON *member = object->child; member; member = member->next)
        if (strcmp(member->string, key) == 0)
            return member;
    return NULL;
}

void json_pointer_append(char *out, size_t n, const char *token) {
    size_t length = strlen(out);
    if (length + 1 >= n)
        return;
    out[length++] = '/';
    for (const unsigned char *c = (const unsigned char *)token; *c;) {
        size_t bytes = utf8_sequence(c, strlen((const char *)c));
        bytes = bytes ? bytes : 1;
        bool escaped = *c == '~' || *c == '/';
        if (length + (escaped ? 2 : bytes) >= n)
            break; // cut at a character, so that the pointer stays UTF-8
        if (escaped) {
            out[length++] = '~';
            out[length++] = *c == '~' ? '0' : '1';
        } else {
            memcpy(out + length, c, bytes);
            length += bytes;
        }
        c += bytes;
    }
    out[length] = 0;
}

// cJSON prints a number with 15 digits where that is within one unit in the last place; a scene
// that is posted back, or read again after a restart, must give the very same doubles.
static void number_text(char out[32], double value) {
    if (fabs(value) < 1e15 && value == (double)(int64_t)value && value != 0) {
        snprintf(out, 32, "%lld", (long long)value); // most are counts, and this is the same text
        return;
    }
    for (int digits = 15; digits < 17; digits++) {
        snprintf(out, 32, "%.*g", digits, value);
        if (strtod(out, NULL) == value)
            return;
    }
    snprintf(out, 32, "%.17g", value); // always the same double
}

// Makes the number an item that cJSON prints as it stands (and that keeps its valuedouble).
static bool number_to_raw(cJSON *item) {
    char text[32];
    number_text(text, item->valuedouble);
    item->valuestring = strdup(text);
    item->type = cJSON_Raw;
    return item->valuestring != NULL;
}

cJSON *json_number(double value) {
    cJSON *item = isfinite(value) ? cJSON_CreateNumber(value) : cJSON_CreateNull();
    if (item && isfinite(value) && !number_to_raw(item)) {
        cJSON_Delete(item);
        return NULL;
    }
    return item;
}

static bool numbers_to_raw(cJSON *item) {
    if (cJSON_IsNumber(item) && isfinite(item->valuedouble) && !number_to_raw(item))
        return false;
    for (cJSON *child = item->child; child; child = child->next)
        if (!numbers_to_raw(child))
            return false;
    return true;
}

char *json_print(const cJSON *json, bool indented) {
    cJSON *copy = cJSON_Duplicate(json, true);
    char *text = NULL;
    if (copy && numbers_to_raw(copy))
        text = indented ? cJSON_Print(copy) : cJSON_PrintUnformatted(copy);
    cJSON_Delete(copy);
    return text;
}

// Most answers fit: growing by doubling, cJSON copies them several times.
#define PRINTED_BYTES 4096

char *json_print_away(cJSON *json) {
    char *text = json != NULL && numbers_to_raw(json)
                     ? cJSON_PrintBuffered(json, PRINTED_BYTES, false)
                     : NULL;
    cJSON_Delete(json);
    return text;
}

void json_digest(const char *text, char *out) {
    snprintf(out, JSON_DIGEST, "%016llx", (unsigned long long)XXH3_64bits(text, strlen(text)));
}
