// SPDX-License-Identifier: GPL-3.0-or-later
//
// A Flamenco 3 job type: bakes, comparisons or pictures by LTSH, in as many tasks as there are shards, and a last task
// that merges them. README.md in this folder says how to install and submit it.

const JOB_TYPE = {
    label: "LTSH Bake",
    description: "Bake, compare, shade, render or view with LTSH: a task for each shard, then one that merges",
    settings: [
        {
            key: "command", label: "What", type: "string", choices: ["bake", "compare", "shade", "render", "view"],
            default: "bake", required: true,
            description: "bake: textures of objects; compare: pictures beside Cycles; shade: pictures alone; "
                + "render: finished pictures, with the rest by Cycles; view: quick ones, as the viewport draws them",
        },
        {
            key: "output", label: "Output Folder", type: "string", subtype: "dir_path", required: true,
            eval: "str(Path(bpy.data.filepath).parent / 'ltsh' / settings.command) if bpy.data.filepath else ''",
            evalInfo: { showLinkButton: true, description: "ltsh/bake or the like beside the file" },
            description: "Folder that all workers see under the same path; one job, one folder. "
                + "// is the folder of this file",
        },
        {
            key: "shards", label: "Shards", type: "int32", default: 4, required: true, propargs: { min: 1, max: 1000 },
            description: "In how many tasks the frames and objects are split; more than there are do no harm",
        },
        {
            key: "frames", label: "Frames", type: "string", default: "",
            eval: "str(C.scene.frame_current)",
            evalInfo: { showLinkButton: true, description: "The current frame" },
            description: "Such as 12 or 1-240:2,300; empty: the frame that the file was saved at",
        },
        {
            key: "techniques", label: "Techniques", type: "string", default: "ltsh4c",
            description: "Some of ltc, ltsh2, ltsh4, ltsh4c, reference, separated by commas; render takes one, and "
                + "render and view no reference",
        },
        {
            key: "passes", label: "Passes", type: "string", default: "specular,diffuse",
            description: "Bake, compare, shade: some of specular, diffuse and, of a bake, diffuse_light, combined",
        },
        {
            key: "objects", label: "Objects", type: "string", default: "",
            description: "Bake: names separated by semicolons; empty: all meshes that render",
        },
        {
            key: "size", label: "Texture Size", type: "int32", default: 1024, propargs: { min: 64, max: 8192 },
            description: "Bake: texels on a side",
        },
        {
            key: "error", label: "Beside Cycles", type: "bool", default: false,
            description: "Bake: also Cycles' own bake, and the signed errors",
        },
        {
            key: "apply", label: "Apply", type: "bool", default: false,
            description: "Bake: also a copy of the .blend whose materials show the textures",
        },
        {
            key: "cycles_samples", label: "Cycles Samples", type: "int32", default: 0, propargs: { min: 0 },
            description: "Compare, bake beside Cycles, render; 0: 512, of a bake 256, of render as in the file",
        },
        {
            key: "arguments", label: "Further Arguments", type: "string", default: "",
            description: "Other options of the command, separated by spaces, such as --shadow-rays 64 --camera Left",
        },
        {
            key: "blendfile", label: "Scene", type: "string", required: true, visible: "web",
            description: "The .blend",
        },
        // Flamenco may have workers open a copy of the file elsewhere, and checks a job under a name without a folder.
        { key: "folder", label: "Folder", type: "string", visible: "hidden", eval: "str(Path(bpy.data.filepath).parent)" },
        { key: "blender", label: "Blender", type: "string", default: "{blender}", visible: "hidden" },
    ],
};

// Called by Flamenco Manager.
function compileJob(job) {
    const settings = withDefaults(job.settings);
    checkSettings(settings);
    settings.output = job.settings.output = outputFolder(settings);
    const mergeTask = ltshTask("merge", settings, ["merge", settings.output]);
    const shared = sharedArguments(settings);
    for (let number = 1; number <= settings.shards; number++) {
        const shard = number + "/" + settings.shards;
        // A task that is done again, on this worker or another, keeps what it had finished.
        const task = ltshTask(settings.command + "-" + number, settings, shared.concat(["--shard", shard, "--resume"]));
        mergeTask.addDependency(task);
        job.addTask(task);
    }
    job.addTask(mergeTask);
}

// Flamenco passes on what was submitted: by a script, maybe not all.
function withDefaults(given) {
    const settings = {};
    for (const setting of JOB_TYPE.settings) {
        const value = given[setting.key];
        settings[setting.key] = value === undefined || value === null ? setting.default : value;
    }
    return settings;
}

// Blender's // stands for the folder of the file that was submitted.
function outputFolder(settings) {
    if (!settings.output.startsWith("//")) {
        return settings.output;
    }
    const folder = settings.folder || settings.blendfile.replace(/[\/\\]?[^\/\\]*$/, "");
    if (!folder) {
        throw new Error("output is " + settings.output + ", but blendfile, " + settings.blendfile
            + ", has no folder: give a path that all workers see");
    }
    return folder + "/" + settings.output.slice(2);
}

function checkSettings(settings) {
    for (const key of ["blendfile", "output"]) {
        if (!settings[key]) {
            throw new Error(key + " is empty, expected a path that all workers see");
        }
    }
    const commands = JOB_TYPE.settings[0].choices;
    if (!commands.includes(settings.command)) {
        throw new Error("command is " + settings.command + ", expected one of " + commands.join(", "));
    }
    if (!(settings.shards >= 1)) {
        throw new Error("shards is " + settings.shards + ", expected 1 or more");
    }
    if (settings.cycles_samples !== 0 && !(settings.cycles_samples >= 2)) {
        throw new Error("cycles_samples is " + settings.cycles_samples + ", expected 0, or 2 or more");
    }
}

// `blender --command ltsh ...`: it ends with a code other than 0 where something failed, which fails the task.
function ltshTask(name, settings, args) {
    const task = author.Task(name, "blender");
    task.addCommand(author.Command("exec", {
        exe: settings.blender,
        args: ["--command", "ltsh"].concat(args),
    }));
    return task;
}

function sharedArguments(settings) {
    const baking = settings.command === "bake";
    const withPasses = !["render", "view"].includes(settings.command);
    const withCycles = ["compare", "render"].includes(settings.command) || (baking && settings.error);
    const args = [settings.command, settings.blendfile, "-o", settings.output];
    for (const key of ["techniques", "passes", "frames"]) {
        // With = also a first frame below 0 is a value, not an option.
        if (settings[key] && (key !== "passes" || withPasses)) {
            args.push("--" + key + "=" + settings[key]);
        }
    }
    if (baking) {
        args.push("--size", String(settings.size));
        for (const name of names(settings.objects)) {
            args.push("--object=" + name);
        }
        for (const key of ["error", "apply"]) {
            if (settings[key]) {
                args.push("--" + key);
            }
        }
    }
    if (withCycles && settings.cycles_samples) {
        args.push("--cycles-samples", String(settings.cycles_samples));
    }
    return args.concat(settings.arguments.split(/\s+/).filter((word) => word !== ""));
}

function names(text) {
    return text.split(";").map((name) => name.trim()).filter((name) => name !== "");
}
