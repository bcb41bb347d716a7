"""What the panels show, drawn into a recorded layout; how they look is for the drivers in tests/gui."""

import bpy
import pytest
import scene_parts as parts
from recorded_layout import Layout, buttons, context_of, drawn, stand_in, texts

from ltsh_addon.blender.ui import panels, preflight, results, settings
from ltsh_addon.blender.ui.job import Job, Plan, Step

MAIN_3D, MAIN_RENDER, *PARTS = panels.CLASSES[1:-1]
LIGHTS, COMPARE, BAKE, RESULTS, FINAL, QUALITY, MATERIALS = PARTS[::2]
JOBS = ("ltsh.compare", "ltsh.shade")
BAKES = ("ltsh.bake", "ltsh.apply_bake", "ltsh.restore_materials")


def all_panels():
    """Every panel of ours that is registered."""
    ours = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("LTSH_PT_")]
    ours = [panel for panel in ours if panel.__module__.startswith("ltsh_addon") and hasattr(panel, "draw")]
    # Blender's own code draws that of the presets, and names it after the last one that was chosen.
    return [panel for panel in ours if panel.__name__ != "LTSH_PT_presets"]


def classes(base):
    """Every class of ours that is registered."""
    return [kind for kind in base.__subclasses__() if kind.__module__.startswith("ltsh_addon") and kind.is_registered]


@pytest.fixture
def add_results(scene, tmp_path, show_results):
    """A function that shows results of these pictures."""

    def add(partial="", names=("ltsh4c", "cycles")):
        row = {"relative_l2": 0.1234, "bias": -0.0151, "flip": 0.0321, "unbiased_squared_error": 0.01}
        rows = {name: {"against_cycles": row} for name in names if name != "cycles"}
        passes = {"specular": {"noise": 0.02, "techniques": rows}}
        report = {"passes": passes, "warnings": ["Light 'Key': approximated"]}
        show_results(scene, tmp_path, 1, names, report, partial)

    return add


@pytest.mark.parametrize(
    "mistake",
    [
        lambda layout: layout.label(txt="x"),
        lambda layout: layout.label(text="x", icon="NO_SUCH_ICON"),
        lambda layout: layout.prop(bpy.context.scene, "no_such_property"),
        lambda layout: layout.lable(text="x"),
        lambda layout: setattr(layout, "enable", False),
        lambda layout: setattr(layout.operator("ltsh.add_uv_map"), "no_such_property", 1),
        lambda layout: layout.operator("ltsh.no_such_operator"),
    ],
)
def test_the_recorder_refuses_what_blender_refuses(scene, mistake):
    with pytest.raises((AssertionError, AttributeError, KeyError)):
        mistake(Layout())


def test_everything_that_can_be_clicked_says_what_it_does(scene):
    operators_of_ours = classes(bpy.types.Operator)
    assert len(operators_of_ours) >= 18
    said = {panel: (panel.bl_label, "of a panel") for panel in all_panels()}
    for kind in operators_of_ours:
        name = kind.bl_idname.partition("_OT_")[2] or kind.bl_idname.partition(".")[2]
        assert kind.bl_label[0].isupper(), kind
        said[kind] = kind.bl_label, getattr(bpy.ops.ltsh, name).get_rna_type().description
    for kind in (*operators_of_ours, *classes(bpy.types.PropertyGroup), *classes(bpy.types.AddonPreferences)):
        for item in kind.bl_rna.properties:
            if item.identifier in getattr(kind, "__annotations__", {}) and not item.is_hidden:
                if item.type != "COLLECTION":
                    said[kind, item.identifier] = item.name, item.description
                for choice in item.enum_items if item.type == "ENUM" else ():
                    said[kind, item.identifier, choice.name] = choice.name, choice.description
    assert len(said) >= 60
    for where, (label, description) in said.items():
        assert label and len(description) > 8 and not description.endswith("."), (where, label, description)


@pytest.mark.parametrize("width", [220, 420, 900])
def test_every_panel_draws_in_every_state(scene, tmp_path, add_results, width):
    """Nothing selected and no results, a job that runs, results that are partial, and those that are complete."""
    drawn_panels = all_panels()
    assert len(drawn_panels) >= 17

    def draw_all():
        for panel in drawn_panels:
            for function in ("draw", "draw_header_preset"):
                if hasattr(panel, function):
                    drawn(panel, function, width)

    draw_all()
    results.state["job"] = Job("Compare with Cycles", Plan([Step("Cycles A", 1.0)]), tmp_path, "compare", 0)
    draw_all()
    results.state["job"] = None
    for partial in ("Not complete: without Cycles", ""):
        add_results(partial, ("ltc", "ltsh4c") if partial else ("ltc", "ltsh4c", "cycles"))
        draw_all()
    bpy.ops.object.select_all(action="SELECT")
    for mode in ("A", "WIPE", "SIDE", "ERROR"):
        scene.ltsh.mode = mode
        draw_all()


@pytest.mark.parametrize("width", [220, 300, 600])
def test_sentences_are_broken_into_lines_that_fit(scene, width):
    """At 220 pixels too; letters of Blender's interface are 6.6 pixels wide on average."""
    scene.camera = None
    bpy.data.objects["Light"].hide_render = True
    for factor in (1.0, 2.0):
        shown = drawn(COMPARE, width=width * factor, scale=factor)
        assert "The scene has no active camera" in texts(shown)
        lines = [item.what for item in shown if item.kind == "label"]
        assert max(len(line) for line in lines) * 6.6 < max(width, 16 * 6.6), lines


def test_both_places_show_the_same(scene):
    assert drawn(MAIN_3D) == drawn(MAIN_RENDER)
    for first, second in zip(PARTS[::2], PARTS[1::2], strict=True):
        assert drawn(first) == drawn(second)
        assert (first.bl_space_type, second.bl_space_type) == ("VIEW_3D", "PROPERTIES")


def test_buttons_are_gray_where_something_is_missing_which_is_said(scene):
    assert buttons(drawn(MAIN_3D)) == {"ltsh.preview": True}
    shown = drawn(COMPARE)
    assert buttons(shown) == dict.fromkeys(JOBS, True)
    assert "24 × 16 px" in texts(shown)
    scene.camera = None
    shown = drawn(COMPARE)
    assert "The scene has no active camera" in texts(shown)
    assert buttons(shown) == dict.fromkeys(JOBS, False) | {"ltsh.add_camera": True}


def test_without_openexr_only_the_preview_can_be_clicked(scene, monkeypatch):
    monkeypatch.setattr("ltsh_addon.blender.ui.preflight.missing_libraries", lambda: "OpenEXR cannot be imported (x)")
    bpy.data.objects["Floor"].select_set(True)
    shown = drawn(COMPARE)
    assert "OpenEXR cannot be imported" in texts(shown)
    assert buttons(shown) == dict.fromkeys(JOBS, False) and buttons(drawn(MAIN_3D)) == {"ltsh.preview": True}
    bake = drawn(BAKE)
    assert "OpenEXR cannot be imported" in texts(bake) and not buttons(bake)["ltsh.bake"]
    for operator in (bpy.ops.ltsh.shade, bpy.ops.ltsh.compare, bpy.ops.ltsh.bake):
        with pytest.raises(RuntimeError, match="OpenEXR cannot be imported"):
            operator()
    monkeypatch.undo()
    assert preflight.missing_libraries() is None


@pytest.mark.parametrize(("command", "panel", "other"), [("compare", COMPARE, BAKE), ("shade", COMPARE, BAKE),
                                                          ("bake", BAKE, COMPARE)])  # fmt: skip
def test_a_running_job_stands_in_the_place_of_its_buttons_and_nothing_moves(scene, tmp_path, command, panel, other):
    bpy.data.objects["Floor"].select_set(True)
    before = {one: (heights(one), drawn(one)) for one in (MAIN_3D, panel, other)}
    plan = Plan([Step("samples", 30.0), Step("Cycles A", 100.0)])
    job = results.state["job"] = Job("Compare with Cycles", plan, tmp_path, command, 0)
    job._take({"stage": "Cycles A", "fraction": 0.25})
    plan._share = 0.25
    shown = drawn(panel)
    assert buttons(shown) == {"ltsh.cancel": True} and texts(drawn(panel, "draw_header_preset")) == "25 %"
    (progress,) = [item.what for item in shown if item.kind == "progress"]
    assert progress.startswith("25 %")
    assert "Cycles, First Half" in texts(shown)
    for one, (rows, _) in before.items():
        assert heights(one) == rows
    # What cannot be started now is gray, where it was.
    assert drawn(MAIN_3D) == before[MAIN_3D][1] and texts(drawn(other, "draw_header_preset")) == ""
    assert not {name for name, can in buttons(drawn(other)).items() if can} & {*JOBS, "ltsh.bake"}
    assert [item.what for item in drawn(other)] == [item.what for item in before[other][1]]


def heights(panel):
    """Of the rows of a panel, one below the other."""
    rows = []

    class Rows(Layout):
        def _called(self, name, given):
            nested = super()._called(name, given)
            rows.append(nested)
            return nested

    found = stand_in(panel)()
    found.layout = Rows()
    found.draw(context_of(300, space_data=None))
    return [vars(one).get("scale_y", 1.0) if isinstance(one, Layout) else 1.0 for one in rows]


def row(ob, width=300):
    """What the list of lights draws for `ob`."""
    layout = Layout()
    stand_in(panels.LTSH_UL_lights)().draw_item(context_of(width), layout, bpy.context.scene, ob, 0, None, "")
    return layout.shown


def test_several_selected_objects_are_listed_with_check_marks(scene):
    ball = parts.add_sphere(name="Ball", segments=8)
    for ob in (ball, bpy.data.objects["Floor"], bpy.data.objects["Light"]):
        ob.select_set(True)
    listed, layout = stand_in(preflight.LTSH_UL_baked)(), Layout()
    listed.bitflag_filter_item, listed.filter_name = 1 << 30, ""
    flags, order = listed.filter_items(bpy.context, scene, "objects")
    assert order == [] and {ob.name for ob, flag in zip(scene.objects, flags, strict=True) if flag} == {"Ball", "Floor"}
    listed.draw_item(bpy.context, layout, scene, ball, 0, None, "")
    assert "Ball" in texts(layout.shown) and "ltsh_baked" in [item.what for item in layout.shown]
    assert "2 objects" in texts(drawn(BAKE))
    ball.ltsh_baked = False
    assert "1 object" in texts(drawn(BAKE))


def test_the_list_of_lights_shows_lights_alone_and_finds_them_by_name(scene):
    parts.add_area_light("Key")
    listed = stand_in(panels.LTSH_UL_lights)()
    listed.bitflag_filter_item, listed.filter_name = 1 << 30, ""
    listed.use_filter_invert = listed.use_filter_sort_alpha = False

    def names():
        flags, order = listed.filter_items(bpy.context, scene, "objects")
        assert order == []
        return [ob.name for ob, flag in zip(scene.objects, flags, strict=True) if flag]

    assert sorted(names()) == ["Key", "Light"]
    listed.filter_name = "KE"
    assert names() == ["Key"]
    bpy.data.objects["Light"].hide_render = True
    assert [item.what for item in row(bpy.data.objects["Light"])] == ["name", "energy", "color", "solo", "mute"]
    # In narrow regions the name needs the place.
    assert [item.what for item in row(bpy.data.objects["Key"], 220)] == ["name", "color", "solo", "mute"]


def test_sizes_of_a_light_are_named_as_in_the_panels_of_blender(scene):
    light = bpy.data.objects["Light"].data
    for shape, sizes in (("SQUARE", ["Size"]), ("RECTANGLE", ["Size X", "Size Y"]), ("ELLIPSE", ["Size X", "Size Y"])):
        light.shape = shape
        found = panels.light_properties(light)
        assert [label for name, label in found.items() if name.startswith("size")] == sizes
    light = bpy.data.lights.new("Spot", "SPOT")
    assert list(panels.light_properties(light).values())[-3:] == ["Radius", "Spot Size", "Blend"]


def test_a_click_in_the_list_selects_the_light_and_a_selected_light_is_chosen_in_it(scene):
    light, floor = bpy.data.objects["Light"], bpy.data.objects["Floor"]
    floor.select_set(True)
    bpy.context.view_layer.objects.active = floor
    assert scene.ltsh.active_light == -1
    scene.ltsh.active_light = scene.objects.find("Light")
    assert bpy.context.selected_objects == [light] and bpy.context.view_layer.objects.active == light
    assert scene.objects[scene.ltsh.active_light] == light
    scene.ltsh.active_light = len(scene.objects)
    assert bpy.context.view_layer.objects.active == light


def test_solo_hides_the_others_and_gives_back_what_was_hidden(scene):
    for name in ("Key", "Fill", "Rim"):
        parts.add_area_light(name)
    key, fill, rim, light = (bpy.data.objects[name] for name in ("Key", "Fill", "Rim", "Light"))
    fill.hide_render = True

    def hidden():
        return [(ob.hide_viewport, ob.hide_render) for ob in (key, fill, rim, light)]

    before = hidden()
    key.ltsh_light.solo = True
    assert hidden() == [(False, False), *3 * [(True, True)]]
    assert [ob.ltsh_light.mute for ob in (key, fill, rim, light)] == [False, True, False, False]
    rim.ltsh_light.solo = rim.ltsh_light.mute = True
    light.ltsh_light.mute = True
    key.ltsh_light.solo = False
    assert hidden() == [(True, True)] * 4
    rim.ltsh_light.solo = False
    assert hidden() == [(False, False), before[1], (True, True), (True, True)]
    for ob in (rim, light):
        ob.ltsh_light.mute = False
    assert hidden() == before
    # A light that a solo has hidden, whose soloed one is gone, can be unmuted.
    key.ltsh_light.solo = True
    bpy.data.objects.remove(key)
    rim.ltsh_light.mute = False
    assert not rim.hide_render and not rim.hide_viewport


def test_views_show_shadows_that_are_switched_off_at_once(scene, monkeypatch):
    drawn_again = []
    monkeypatch.setattr(settings, "redraw_editors", lambda *kinds: drawn_again.append(kinds))
    scene.ltsh.shadows = not scene.ltsh.shadows
    assert drawn_again == [("VIEW_3D",)]


def test_complete_is_on_at_first_and_in_a_panel_that_is_open(scene):
    scene.render.engine = "LTSH"
    assert scene.ltsh_view.complete and "DEFAULT_CLOSED" not in getattr(FINAL, "bl_options", ())
    assert "complete" in [item.what for item in drawn(FINAL)] and FINAL.poll(bpy.context)


def test_lights_and_materials_are_listed_with_what_is_not_exact(scene):
    parts.add_area_light("Torn", scale=(1.0, 0.0, 1.0))
    glass, _ = parts.bsdf_material("ShaderNodeBsdfHairPrincipled", "Fur")
    parts.add_plane(glass, name="Fur")
    bpy.context.view_layer.update()
    signs = {name: row(bpy.data.objects[name])[0].icon for name in ("Light", "Torn")}
    assert signs == {"Light": "LIGHT_AREA", "Torn": "CANCEL"}
    header = drawn(LIGHTS, "draw_header_preset")
    assert [item.what for item in header] == ["2", "1"]
    bpy.context.view_layer.objects.active = bpy.data.objects["Torn"]
    assert "its size or scale is zero" in texts(drawn(LIGHTS))
    signs = {item.what: item.icon for item in drawn(MATERIALS) if item.icon}
    assert signs["Floor"] == "CHECKMARK" and signs["Fur"] == "CANCEL"


def test_numbers_are_those_of_the_report(scene, tmp_path, add_results):
    add_results()
    shown = drawn(RESULTS)
    for number in ("L2 %", "12.34", "-1.51", "0.0321", "Noise of Cycles 2.00 %", "LTSH 4c 10.00 %"):
        assert number in texts(shown).replace("\u00a0", " "), number
    narrow = texts(drawn(RESULTS, width=220)).replace("\u00a0", " ")
    assert "LTSH 4c: L2 12.34 %, bias -1.51 %, FLIP 0.0321" in narrow
    assert "Not complete" not in narrow
    assert buttons(shown)["wm.path_open"] and "ltsh_warnings" in [item.what for item in shown if item.kind == "panel"]
    # While the job runs that adds Cycles; pictures that a cancelled job left are what they are.
    add_results("Not complete: without Cycles", ("ltc", "ltsh4c"))
    job = results.state["job"] = Job("Compare with Cycles", Plan([Step("Cycles A", 1.0)]), tmp_path, "compare", 0)
    job.results.append(results.result_of(scene).folder)
    assert "Not complete: without Cycles" in texts(drawn(RESULTS))
    results.state["job"] = None
    assert "Not complete" not in texts(drawn(RESULTS))


def choices(shown):
    """The buttons that choose what the Image Editor shows, each with its property."""
    return [(item.values.key, item) for item in shown if item.what == "ltsh.choose"]


def test_the_image_editor_offers_the_pictures_that_are_there(scene, add_results):
    add_results()
    panel = panels.LTSH_PT_IMAGE_results
    scene.ltsh.mode = "WIPE"
    shown = drawn(panel)
    keys, shown = [key for key, _ in choices(shown)], [item.what for item in shown]
    assert keys.count("first") == keys.count("second") == 2 and "split" in shown and "error_scale" not in shown
    scene.ltsh.mode = "ERROR"
    shown = [item.what for item in drawn(panel)]
    assert "error_scale" in shown and "split" not in shown


@pytest.mark.parametrize("mode", ["WIPE", "SIDE", "ERROR", "A"])
def test_a_picture_alone_is_shown_whole_whatever_the_mode(scene, add_results, mode):
    add_results(names=("ltsh4c",))
    scene.ltsh.mode = mode
    shown = drawn(panels.LTSH_PT_IMAGE_results)
    assert not {"split", "error_scale"} & {item.what for item in shown}
    assert "second" not in [key for key, _ in choices(shown)]
    # Single alone: no lights were kept to mix.
    assert [item.enabled for key, item in choices(shown) if key == "mode"] == [True, False, False, False, False]
    assert results.choice_of(scene.ltsh, results.result_of(scene)).mode == "A"
