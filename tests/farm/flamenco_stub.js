// What Flamenco Manager gives a job type, as far as it is documented; it records tasks and refuses what Flamenco would.
// Followed by the job type, and by `report(SETTINGS)`.

function refuse(text) {
    throw new Error("Flamenco: " + text);
}

const COMMANDS = { exec: { exe: "string", args: "strings" }, "blender-render": {}, "move-directory": {}, echo: {} };
const TASK_TYPES = ["blender", "ffmpeg", "file-management", "misc"];
const SETTING_TYPES = { string: "string", int32: "number", float: "number", bool: "boolean" };
const SETTING_SUBTYPES = ["file_path", "dir_path", "file_name", "hashed_file_path"];
const SETTING_KEYS = ["key", "label", "description", "type", "subtype", "choices", "propargs", "default", "eval",
    "evalInfo", "visible", "required", "editable"];
const EVAL_INFO_KEYS = ["showLinkButton", "description"];

const author = {
    Task: function (name, type) {
        if (typeof name !== "string" || !TASK_TYPES.includes(type)) {
            refuse("task " + name + " has the type " + type);
        }
        const task = { name: name, type: type, commands: [], dependencies: [] };
        task.addCommand = (command) => task.commands.push(command);
        task.addDependency = (other) => task.dependencies.push(other);
        return task;
    },
    Command: function (name, parameters) {
        if (!(name in COMMANDS)) {
            refuse("command " + name + " is unknown");
        }
        for (const [key, kind] of Object.entries(COMMANDS[name])) {
            const value = parameters[key];
            const right = kind === "strings"
                ? Array.isArray(value) && value.every((item) => typeof item === "string")
                : typeof value === kind;
            if (!right) {
                refuse("command " + name + ": " + key + " is " + JSON.stringify(value));
            }
        }
        return { name: name, parameters: parameters };
    },
};

function checkJobType() {
    for (const setting of JOB_TYPE.settings) {
        const wrong = Object.keys(setting).filter((key) => !SETTING_KEYS.includes(key));
        if (wrong.length || !(setting.type in SETTING_TYPES)) {
            refuse("setting " + setting.key + ": " + wrong + " " + setting.type);
        }
        if (!Object.keys(setting.evalInfo || {}).every((key) => EVAL_INFO_KEYS.includes(key))) {
            refuse("setting " + setting.key + ": evalInfo has " + Object.keys(setting.evalInfo));
        }
        if ("subtype" in setting && !SETTING_SUBTYPES.includes(setting.subtype)) {
            refuse("setting " + setting.key + " has the subtype " + setting.subtype);
        }
        if ("default" in setting && typeof setting.default !== SETTING_TYPES[setting.type]) {
            refuse("setting " + setting.key + " has the default " + JSON.stringify(setting.default));
        }
        if ("visible" in setting && !["visible", "hidden", "submission", "web"].includes(setting.visible)) {
            refuse("setting " + setting.key + " is visible " + setting.visible);
        }
    }
}

// The manager fills in no defaults.
function compiled(given) {
    const tasks = [];
    compileJob({ name: "test", settings: given, addTask: (task) => tasks.push(task) });
    return tasks.map((task) => ({
        name: task.name, type: task.type, commands: task.commands,
        dependencies: task.dependencies.map((other) => tasks.indexOf(other)),
    }));
}

function report(given) {
    let found;
    try {
        checkJobType();
        found = { settings: JOB_TYPE.settings, tasks: compiled(given), given: given };
    } catch (error) {
        found = { error: error.message };
    }
    console.log(JSON.stringify(found));
}
