// The paths come from the table that routes, the schemas of what goes in from the tables that check
// it; those of what comes out stand here as JSON.
#include "server/openapi.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/bodies.h"
#include "server/routes.h"
#include "server/scene.h"

// What every route may answer, and what it means.
static const struct {
    const char *status, *description;
} problems[] = {
    {"304", "the copy that the browser has is still the same"},
    {"400", "not JSON, or a malformed request"},
    {"401", "no valid bearer token"},
    {"403", "foreign Origin"},
    {"404", "no such thing"},
    {"405", "not by this method; Allow lists those that are"},
    {"409", "not in this state, or a duplicate id; the detail names the state"},
    {"412", "the configuration is not the one that If-Match names"},
    {"413", "body over the limit"},
    {"415", "body is not JSON by its Content-Type"},
    {"421", "foreign Host"},
    {"422", "every fault of the body"},
    {"431", "head of the request over the limit"},
    {"500", "a damaged file"},
    {"503", "not now; Retry-After says when"},
    {"507", "the disk refuses"},
};
static const char everywhere[] = "400 401 403 405 421 431 503";

static const struct {
    const char *name, *json;
} schemas[] = {
    {"Problem",
     "{\"type\":\"object\",\"required\":[\"type\",\"title\",\"status\",\"detail\",\"errors\""
     "],\"properties\":{\"type\":{\"type\":\"string\"},\"title\":{\"type\":\"string\"},\"sta"
     "tus\":{\"type\":\"integer\"},\"detail\":{\"type\":\"string\"},\"errors\":{\"type\":\"a"
     "rray\",\"items\":{\"$ref\":\"#/components/schemas/Fault\"}}}}"},
    {"Fault",
     "{\"type\":\"object\",\"required\":[\"pointer\",\"code\",\"detail\"],\"properties\":{\""
     "pointer\":{\"type\":\"string\",\"description\":\"RFC 6901; of a scene, below /scene of"
     " the body\"},\"code\":{\"type\":\"string\"},\"expected\":{\"type\":[\"string\",\"null"
     "\"]},\"actual\":{\"type\":[\"string\",\"null\"]},\"detail\":{\"type\":\"string\"}}}"},
    {"Number",
     "{\"type\":[\"number\",\"null\"],\"description\":\"null: not finite, or not known yet\""
     "}"},
    {"Vector", "{\"type\":\"array\",\"items\":{\"$ref\":\"#/components/schemas/Number\"}}"},
    {"Health",
     "{\"type\":\"object\",\"required\":[\"status\"],\"properties\":{\"status\":{\"type\":\""
     "string\"}}}"},
    {"Object", "{\"type\":\"object\"}"},
    {"Service",
     "{\"type\":\"object\",\"required\":[\"name\",\"version\",\"build\",\"instruction_set\","
     "\"threads\",\"limits\",\"endpoints\"],\"properties\":{\"name\":{\"const\":\"fbard\"},"
     "\"version\":{\"type\":\"string\"},\"build\":{\"type\":\"string\"},\"instruction_set\":"
     "{\"type\":\"string\"},\"threads\":{\"type\":\"integer\"},\"slots\":{\"type\":\"integer"
     "\"},\"limits\":{\"type\":\"object\"},\"endpoints\":{\"type\":\"object\"}}}"},
    {"Materials",
     "{\"type\":\"object\",\"required\":[\"materials\"],\"properties\":{\"materials\":{\"typ"
     "e\":\"array\",\"items\":{\"type\":\"object\"}}}}"},
    {"Scenes",
     "{\"type\":\"object\",\"required\":[\"scenes\"],\"properties\":{\"scenes\":{\"type\":\""
     "array\",\"items\":{\"type\":\"object\",\"required\":[\"name\",\"title\"],\"properties"
     "\":{\"name\":{\"type\":\"string\"},\"title\":{\"type\":\"string\"}}}}}}"},
    {"Valid",
     "{\"type\":\"object\",\"required\":[\"valid\",\"estimate\",\"warnings\"],\"properties\":{"
     "\"warnings\":{\"type\":\"array\",\"items\":{\"type\":\"string\"}},\"valid\":{"
     "\"const\":true},\"estimate\":{\"type\":\"object\",\"required\":[\"particles\",\"nodes"
     "\",\"dt\",\"dt_limit\",\"steps\",\"bytes\"],\"properties\":{\"particles\":{\"type\":\""
     "integer\"},\"nodes\":{\"type\":\"integer\"},\"dt\":{\"type\":\"number\"},\"dt_limit\":"
     "{\"$ref\":\"#/components/schemas/Number\"},\"steps\":{\"type\":\"number\"},\"bytes\":{"
     "\"type\":\"integer\"}}}}}"},
    {"State",
     "{\"enum\":[\"queued\",\"running\",\"waiting\",\"paused\",\"completed\",\"failed\",\"ca"
     "ncelled\"]}"},
    {"Run",
     "{\"type\":\"object\",\"required\":[\"id\",\"state\",\"step\",\"time\",\"end_time\",\"p"
     "rogress\",\"eta_s\",\"dt\",\"fbar\",\"particles\",\"scene\",\"created\",\"error\",\"wa"
     "rnings\",\"revision\",\"changes\",\"performance\",\"balance\",\"probes\",\"accuracy\"],"
     "\"properties\":{\"id\":{"
     "\"type\":\"string\"},\"state\":{\"$ref\":\"#/components/schemas/State\"},\"step\":{\"t"
     "ype\":\"integer\"},\"time\":{\"$ref\":\"#/components/schemas/Number\"},\"end_time\":{"
     "\"$ref\":\"#/components/schemas/Number\"},\"progress\":{\"type\":\"number\",\"minimum"
     "\":0,\"maximum\":1},\"eta_s\":{\"$ref\":\"#/components/schemas/Number\"},\"dt\":{\"$re"
     "f\":\"#/components/schemas/Number\"},\"fbar\":{\"type\":\"boolean\"},\"fbar_scheme\":{"
     "\"type\":\"string\"},\"particles\":{\"type\":\"integer\"},\"scene\":{\"type\":\"string"
     "\"},\"created\":{\"type\":\"string\"},\"error\":{\"type\":[\"object\",\"null\"]},\"war"
     "nings\":{\"type\":\"array\",\"items\":{\"type\":\"string\"}},\"revision\":{\"type\":"
     "\"integer\",\"minimum\":0,\"description\":\"changes of the configuration so far\"},"
     "\"changes\":{\"type\":\"array\",\"maxItems\":32,\"description\":\"the newest of them\","
     "\"items\":{\"$ref\":\"#/components/schemas/Change\"}},\"journal\":{\"type\":[\"object\","
     "\"null\"]},\"recorders\":{\"type\":\"array\","
     "\"items\":{\"$ref\":\"#/components/schemas/Recorder\"}},\"performance\":{\"type\""
     ":\"object\",\"required\":[\"wall_s\",\"particle_steps_per_s\",\"bytes_per_particle\","
     "\"threads\",\"phases\"],\"properties\":{\"threads\":{\"type\":[\"integer\",\"null\"],"
     "\"minimum\":1},\"wall_s\":{\"type\":\"number\"},\"particle_steps_per_s\":"
     "{\"$ref\":\"#/components/schemas/Number\"},\"bytes_per_particle\":{\"$ref\":\"#/compon"
     "ents/schemas/Number\"},\"phases\":{\"type\":\"object\",\"additionalProperties\":{\"typ"
     "e\":\"number\"}}}},\"balance\":{\"type\":\"object\",\"required\":[\"mass\",\"momentum"
     "\",\"angular_momentum\",\"kinetic_energy\",\"strain_energy\",\"external_work\"],\"prop"
     "erties\":{\"mass\":{\"$ref\":\"#/components/schemas/Number\"},\"momentum\":{\"$ref\":"
     "\"#/components/schemas/Vector\"},\"angular_momentum\":{\"$ref\":\"#/components/schemas"
     "/Vector\"},\"kinetic_energy\":{\"$ref\":\"#/components/schemas/Number\"},\"strain_ener"
     "gy\":{\"$ref\":\"#/components/schemas/Number\"},\"external_work\":{\"$ref\":\"#/compon"
     "ents/schemas/Number\"}}},\"probes\":{\"type\":\"object\"},\"accuracy\":{\"type\":\"arr"
     "ay\",\"items\":{\"type\":\"object\",\"required\":[\"probe\",\"value\",\"reference\",\""
     "relative_error\",\"source\"]}},\"effective_step\":{\"type\":\"integer\"},\"frame_seq\""
     ":{\"type\":\"integer\"}}}"},
    {"Change",
     "{\"type\":\"object\",\"required\":[\"revision\",\"step\",\"time\",\"patch\"],\"properties\":{"
     "\"revision\":{\"type\":\"integer\",\"minimum\":1},\"step\":{\"type\":\"integer\"},\"time\":{"
     "\"$ref\":\"#/components/schemas/Number\"},\"patch\":{\"type\":\"object\"}}}"},
    {"Changes",
     "{\"type\":\"object\",\"required\":[\"changes\"],\"properties\":{\"changes\":{\"type\":"
     "\"array\",\"items\":{\"$ref\":\"#/components/schemas/Change\"}}}}"},
    {"Text", "{\"type\":\"string\"}"},
    {"Runs",
     "{\"type\":\"object\",\"required\":[\"runs\"],\"properties\":{\"older\":{\"type\":\"integer"
     "\"},\"runs\":{\"type\":\"array\",\"items\":{\"$ref\":\"#/components/schemas/Run\"}}}}"},
    {"Config",
     "{\"type\":\"object\",\"properties\":{\"fbar\":{},\"damping\":{},\"transfer\":{},\"time"
     "\":{},\"gravity\":{},\"output\":{},\"effective_step\":{\"type\":\"integer\"}}}"},
    {"Scene",
     "{\"type\":\"object\",\"required\":[\"format\"],\"description\":\"see /v1/schemas/scene"
     ".json\"}"},
    {"Probes",
     "{\"type\":\"object\",\"required\":[\"step\",\"time\",\"probes\"],\"properties\":{\"ste"
     "p\":{\"type\":\"array\",\"items\":{\"type\":\"integer\"}},\"time\":{\"type\":\"array\""
     ",\"items\":{\"type\":\"number\"}},\"probes\":{\"type\":\"object\"}}}"},
    {"Recorder",
     "{\"type\":\"object\",\"required\":[\"name\",\"acked\",\"lag_frames\",\"lag_bytes\"],"
     "\"properties\":{\"name\":{\"type\":\"string\"},\"acked\":{\"type\":\"integer\",\"minimum\""
     ":-1},\"lag_frames\":{\"type\":\"integer\"},\"lag_bytes\":{\"type\":\"integer\"},"
     "\"silent_s\":{\"type\":\"number\"},\"first\":{\"type\":\"integer\"}}}"},
    {"Recorders",
     "{\"type\":\"object\",\"required\":[\"recorders\"],\"properties\":{\"recorders\":{"
     "\"type\":\"array\",\"items\":{\"$ref\":\"#/components/schemas/Recorder\"}}}}"},
    {"Frames",
     "{\"type\":\"object\",\"required\":[\"frames\"],\"properties\":{\"gone\":{\"type\":"
     "\"array\",\"items\":{\"type\":\"object\",\"required\":[\"from\",\"to\"],\"properties\":{"
     "\"from\":{\"type\":\"integer\"},\"to\":{\"type\":\"integer\"}}}},\"first\":{\"type\":\"i"
     "nteger\"},\"frames\":{\"type\":\"array\",\"items\":{\"type\":\"object\",\"required\":["
     "\"seq\",\"step\",\"time\",\"bytes\"],\"properties\":{\"seq\":{\"type\":\"integer\"},\""
     "step\":{\"type\":\"integer\"},\"time\":{\"type\":\"number\"},\"bytes\":{\"type\":\"int"
     "eger\"},\"epoch\":{\"type\":\"integer\"},\"state\":{\"type\":\"string\"},\"end\":{\"ty"
     "pe\":\"boolean\"},\"digest\":{\"type\":\"string\"}}}}}}"},
};

static cJSON *reference(const char *schema) {
    char text[96];
    cJSON *object = cJSON_CreateObject();
    snprintf(text, sizeof text, "#/components/schemas/%s", schema);
    cJSON_AddStringToObject(object, "$ref", text);
    return object;
}

static void add_content(cJSON *to, const char *types, const char *schema) {
    cJSON *content = cJSON_AddObjectToObject(to, "content");
    char list[160], *rest = list;
    snprintf(list, sizeof list, "%s", types);
    for (char *type; (type = strsep(&rest, " ")) != NULL;) {
        cJSON *media = cJSON_AddObjectToObject(content, type);
        if (strstr(type, "json") != NULL)
            cJSON_AddItemToObject(media, "schema", reference(schema));
    }
}

static void add_problems(cJSON *responses, const char *statuses) {
    for (size_t k = 0; k < sizeof problems / sizeof *problems; k++) {
        if (strstr(statuses, problems[k].status) == NULL ||
            cJSON_GetObjectItemCaseSensitive(responses, problems[k].status) != NULL)
            continue;
        cJSON *response = cJSON_AddObjectToObject(responses, problems[k].status);
        cJSON_AddStringToObject(response, "description", problems[k].description);
        if (problems[k].status[0] >= '4')
            add_content(response, "application/problem+json", "Problem");
    }
}

static void add_parameter(cJSON *list, const char *place, const char *name, const char *text) {
    cJSON *parameter = cJSON_CreateObject();
    cJSON_AddStringToObject(parameter, "name", name);
    cJSON_AddStringToObject(parameter, "in", place);
    if (text != NULL)
        cJSON_AddStringToObject(parameter, "description", text);
    cJSON_AddBoolToObject(parameter, "required", strcmp(place, "path") == 0);
    cJSON_AddStringToObject(cJSON_AddObjectToObject(parameter, "schema"), "type", "string");
    cJSON_AddItemToArray(list, parameter);
}

static void add_parameters(cJSON *operation, const struct route *route) {
    cJSON *list = cJSON_AddArrayToObject(operation, "parameters");
    for (const char *open = route->pattern; (open = strchr(open, '{')) != NULL; open++) {
        char name[32];
        snprintf(name, sizeof name, "%.*s", (int)strcspn(open + 1, "}"), open + 1);
        add_parameter(list, "path", name, NULL);
    }
    if (route->parameters != NULL) {
        char text[600], *rest = text;
        snprintf(text, sizeof text, "%s", route->parameters);
        for (char *line; (line = strsep(&rest, "\n")) != NULL;) {
            char *colon = strstr(line, ": ");
            if (colon != NULL) {
                *colon = '\0';
                bool header = strncmp(line, "header ", 7) == 0;
                add_parameter(list, header ? "header" : "query", header ? line + 7 : line,
                              colon + 2);
            }
        }
    }
}

static cJSON *operation_of(const struct route *route) {
    cJSON *operation = cJSON_CreateObject();
    char status[8];
    cJSON_AddStringToObject(operation, "summary", route->summary);
    add_parameters(operation, route);
    if (route->request != NULL) {
        cJSON *body = cJSON_AddObjectToObject(operation, "requestBody");
        cJSON_AddBoolToObject(body, "required", route->request_needed);
        add_content(body,
                    route->merge_patch ? "application/json application/merge-patch+json"
                                       : "application/json",
                    route->request);
    }
    cJSON *responses = cJSON_AddObjectToObject(operation, "responses");
    snprintf(status, sizeof status, "%d", route->success);
    cJSON *success = cJSON_AddObjectToObject(responses, status);
    cJSON_AddStringToObject(success, "description", "success");
    if (route->response != NULL)
        add_content(success, route->type, route->response);
    add_problems(responses, everywhere);
    if (route->request != NULL)
        add_problems(responses, "400 413 415 422");
    if (strchr(route->pattern, '{') != NULL)
        add_problems(responses, "404");
    if (route->problems != NULL)
        add_problems(responses, route->problems);
    return operation;
}

cJSON *openapi_document(void) {
    struct faults faults = {0};
    cJSON *document = cJSON_CreateObject(), *info, *paths, *components;
    cJSON_AddStringToObject(document, "openapi", "3.1.0");
    info = cJSON_AddObjectToObject(document, "info");
    cJSON_AddStringToObject(info, "title", "fbard");
    cJSON_AddStringToObject(info, "description",
                            "Control of material-point-method simulations. SI units throughout.");
    cJSON_AddStringToObject(info, "version", FBARD_VERSION);
    paths = cJSON_AddObjectToObject(document, "paths");
    for (size_t k = 0; k < routes_count; k++) {
        const struct route *route = &routes_table[k];
        char method[8];
        size_t n = 0;
        for (; route->method[n] != '\0' && n < sizeof method - 1; n++)
            method[n] = (char)(route->method[n] + ('a' - 'A'));
        method[n] = '\0';
        cJSON *path = cJSON_GetObjectItemCaseSensitive(paths, route->pattern);
        if (path == NULL)
            path = cJSON_AddObjectToObject(paths, route->pattern);
        cJSON_AddItemToObject(path, method, operation_of(route));
    }
    components = cJSON_AddObjectToObject(document, "components");
    cJSON *list = cJSON_AddObjectToObject(components, "schemas");
    for (size_t k = 0; k < sizeof schemas / sizeof *schemas; k++)
        cJSON_AddItemToObject(list, schemas[k].name,
                              json_parse(schemas[k].json, strlen(schemas[k].json), &faults));
    for (size_t k = 0; bodies_name(k) != NULL; k++)
        cJSON_AddItemToObject(list, bodies_name(k), bodies_schema(k));
    faults_free(&faults);
    cJSON *schemes = cJSON_AddObjectToObject(components, "securitySchemes");
    cJSON *token = cJSON_AddObjectToObject(schemes, "token");
    cJSON_AddStringToObject(token, "type", "http");
    cJSON_AddStringToObject(token, "scheme", "bearer");
    return document;
}
