"""A person at the wheel: devices, the drive and what is kept of it. Everything is headless, the devices are emulated."""

import os
import re
import threading
import time
from ctypes import sizeof
from dataclasses import replace

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import gymnasium as gym
import minari
import numpy as np
import pygame
import pytest
from cockpit_toys import Car, cockpit
from guided_toys import make_guided, parameters
from gymnasium import spaces
from shell import FOREVER, wait_until
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chac import CHAC, DPVP, PVP, HGDagger
from sb3_chac.__main__ import main
from sb3_chac.cockpit import window as window_module
from sb3_chac.cockpit.devices import (
    G29,
    GAMEPAD,
    WHEEL,
    Calibration,
    Command,
    DeviceError,
    Joystick,
    Keyboard,
    Spring,
    Steering,
    load_config,
    save_config,
)
from sb3_chac.cockpit.devices.emulator import DeviceEmulator
from sb3_chac.cockpit.devices.feedback import MOST_RAW, SPRING, Condition, sdl
from sb3_chac.cockpit.driven import driven
from sb3_chac.cockpit.person import NotDrivable, Person, check_drivable
from sb3_chac.cockpit.recording import FOLDER
from sb3_chac.cockpit.session import Session, SessionEnded, indicators
from sb3_chac.cockpit.window import Window
from sb3_chac.common.checkpoint_files import sound_checkpoint
from sb3_chac.common.demonstrations import load_demonstrations


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def keyboard():
    clock = Clock()
    device = Keyboard(clock)
    return clock, device, DeviceEmulator(device.handle)


def wheel(config=WHEEL, spring=None):
    clock = Clock()
    emulator = DeviceEmulator(lambda event: answers.append(device.handle(event)))
    answers: list = []
    device = Joystick(config, clock, emulator.open_joystick, spring)
    emulator.plug()
    return device, emulator, answers


# Devices


def test_held_keys_ramp_up_and_return_to_the_middle():
    clock, device, person = keyboard()
    person.press(pygame.K_LEFT)
    person.press(pygame.K_UP)
    steering = []
    for clock.now in (0.1, 0.2, 1.0):
        steering.append(device.read().steering)
    assert 0 > steering[0] > steering[1] > steering[2] == -1
    assert device.read().pedals == 1 and device.read().takeover
    person.release(pygame.K_LEFT)
    person.release(pygame.K_UP)
    clock.now += 0.1
    assert -1 < device.read().steering < 0 < device.read().pedals < 1
    clock.now += 1
    assert device.read()[:2] == (0, 0)
    assert device.read().takeover  # letting go is not handing back


def test_brake_is_stronger_than_throttle_and_faster():
    clock, device, person = keyboard()
    person.press(pygame.K_UP)
    clock.now = 0.1
    throttle = device.read().pedals
    person.press(pygame.K_DOWN)
    clock.now = 0.2
    assert device.read().pedals < -throttle < 0


def test_a_short_tap_between_two_looks_is_not_lost():
    clock, device, person = keyboard()
    clock.now = 0.01
    person.press(pygame.K_RIGHT)
    clock.now = 0.04
    person.release(pygame.K_RIGHT)
    assert device.read().steering > 0.05 and device.read().takeover


def test_space_takes_over_and_hands_back():
    _, device, person = keyboard()
    seen = []
    for _ in range(2):
        person.tap(pygame.K_SPACE)
        seen.append(device.read().takeover)
    assert seen == [True, False]


def test_keyboard_is_lost_with_the_focus_and_no_key_stays_held():
    clock, device, person = keyboard()
    person.press(pygame.K_UP)
    clock.now = 1
    person.lose_focus()
    assert not device.read().connected and device.read().pedals == 0
    person.gain_focus()
    clock.now = 2
    assert device.read().connected and device.read().pedals == 0


def test_wheel_pedals_paddle_and_unplugging():
    device, emulator, answers = wheel()
    assert device.read()[:4] == (0, 0, False, True)  # SDL tells nothing of pedals that nobody touched
    emulator.axis(0, 0.5)
    emulator.axis(2, -1.0)
    assert device.read().steering == pytest.approx(0.49, abs=0.01) and device.read().pedals == 1
    emulator.axis(3, -1.0)
    assert device.read().pedals == -1
    emulator.button(5)
    assert device.read().takeover
    emulator.button(9)
    assert answers[-2] is Command.PAUSE
    emulator.unplug()
    assert not device.read().connected
    emulator.plug()
    assert device.read()[:2] == (0, 0) and device.read().connected


def test_gamepad_has_a_dead_zone_and_others_are_not_listened_to():
    device, emulator, _ = wheel(GAMEPAD)
    emulator.axis(0, -0.1)
    assert device.read().steering == 0
    device.handle(pygame.event.Event(pygame.JOYAXISMOTION, instance_id=99, axis=0, value=1.0))
    assert device.read().steering == 0


def test_g29_drives_while_a_paddle_is_held_and_steers_fully_at_two_thirds_of_the_way():
    device, emulator, _ = wheel(G29)
    emulator.axis(0, -0.67)
    emulator.axis(2, -1.0)
    assert device.read()[:3] == (-1, 1, False)
    emulator.hold_button(4)
    emulator.hold_button(5)
    emulator.release_button(4)
    assert device.read().takeover
    device.hand_back()  # the episode is over: press again
    assert not device.read().takeover
    emulator.hold_button(4)
    assert device.read().takeover
    emulator.release_button(4)
    emulator.release_button(5)
    assert not device.read().takeover


@pytest.mark.parametrize("config", [WHEEL, GAMEPAD, G29], ids=["wheel", "gamepad", "g29"])
@pytest.mark.parametrize("steering", [-1.0, -0.3, 0.0, 0.6, 1.0])
def test_where_an_axis_is_for_a_steering(config, steering):
    assert config.steering.value(config.steering.raw(steering)) == pytest.approx(steering)


class Haptics:
    """
    Stand-in for SDL.

    :param effects: that the wheel offers
    """

    def __init__(self, effects=SPRING):
        self.effects, self.centres, self.calls = effects, [], []

    def SDL_JoystickFromInstanceID(self, number):
        return 1

    def SDL_HapticOpenFromJoystick(self, joystick):
        return 2

    def SDL_HapticQuery(self, haptic):
        return self.effects

    def effect(self, effect):
        condition = effect._obj.condition
        self.centres.append((condition.center[0] / MOST_RAW, condition.left_sat[0], condition.right_coeff[0]))

    def SDL_HapticNewEffect(self, haptic, effect):
        self.effect(effect)
        return 3

    def SDL_HapticUpdateEffect(self, haptic, number, effect):
        self.effect(effect)

    def __getattr__(self, name):
        return lambda *arguments: self.calls.append(name)


def test_a_spring_turns_the_wheel_to_where_the_novice_steers():
    haptics = Haptics()
    device, emulator, _ = wheel(replace(WHEEL, steering=Steering(left=0.9, right=-0.9, dead_zone=0.0)), Spring(0.4, haptics))
    for steering in (0.5, 0.5, -1.0, None, None, 0.25):
        device.feel(steering)
    assert [centre for centre, _, _ in haptics.centres] == pytest.approx([-0.45, 0.9, -0.225], abs=1e-4)
    assert {(saturation, coefficient) for _, saturation, coefficient in haptics.centres} == {(26214, 13107)}  # 40 %
    assert haptics.calls.count("SDL_HapticRunEffect") == 3 and haptics.calls.count("SDL_HapticStopEffect") == 1
    emulator.unplug()
    device.feel(1.0)
    assert haptics.calls[-1] == "SDL_HapticClose" and len(haptics.centres) == 3
    emulator.plug()
    device.feel(1.0)
    assert len(haptics.centres) == 4


def test_a_wheel_without_a_spring_can_be_driven_with(caplog):
    haptics = Haptics(effects=1)
    device, _, _ = wheel(WHEEL, Spring(0.4, haptics))
    assert "offers no spring" in caplog.text and device.read().connected
    device.feel(0.5)
    assert haptics.centres == [] and haptics.calls == ["SDL_HapticClose"]


def test_sdl_is_reached_and_its_structures_have_its_size():
    library = sdl()
    assert library.SDL_HapticOpenFromJoystick(None) is None and b"aptic" in library.SDL_GetError()
    assert (sizeof(Condition), Condition.center.offset, Condition.length.offset) == (68, 60, 20)  # as its header says


def test_the_wheel_follows_the_novice_and_is_free_in_takeovers_and_pauses():
    haptics = Haptics()
    device, emulator, _ = wheel(WHEEL, Spring(1.0, haptics))
    drive = Session(Person(device))
    window = Window("test")
    window.drive = drive
    drive.show(proposed=(0.5, 0.0))
    window.feel()  # paused
    assert haptics.centres == []
    drive.go_on()
    window.feel()
    assert len(haptics.centres) == 1
    emulator.button(4)
    window.feel()
    assert haptics.calls[-1] == "SDL_HapticStopEffect"
    emulator.button(4)
    drive.show(takeover=True)  # the step under way is the person's still
    window.feel()
    assert len(haptics.centres) == 1
    drive.show(takeover=False)
    window.feel()
    assert len(haptics.centres) == 2
    window.close()


def test_keys_are_heard_where_each_frame_takes_too_long(monkeypatch):
    monkeypatch.setattr(window_module, "FRAME_SECONDS", -1.0)  # the next one is always due
    window, (_, device, _) = Window("test"), keyboard()
    drive = Session(Person(device))
    DeviceEmulator().press(pygame.K_q)
    window.run(drive, lambda: drive.ended or window.frames > 20)
    window.close()
    assert drive.ended


def test_calibration_finds_axes_and_is_read_back(tmp_path):
    calibration = Calibration("my wheel")
    person = DeviceEmulator(calibration.handle)
    script = {
        "left": [(1, 0.9)],
        "right": [(1, -0.9)],
        "centre": [(1, 0.02)],
        "throttle": [(3, -1.0)],
        "released": [(3, 1.0)],
        "brake": [(4, -0.8)],
    }
    for axes in script.values():
        for axis, value in axes:
            person.axis(axis, value)
        calibration.answer()
    assert calibration.step == "takeover"
    person.button(7)
    save_config(tmp_path / "wheel.yml", calibration.config())
    config = load_config(tmp_path / "wheel.yml")
    assert config == calibration.config()
    assert config.steering.value(0.9) == -1 and config.steering.value(-0.9) == 1
    assert (config.throttle.axis, config.brake.axis, config.takeover) == (3, 4, (7,))
    assert config.throttle.value(-1.0) == 1 and config.throttle.value(1.0) == 0 and config.brake.value(1.0) == 0


def test_calibration_asks_again_when_nothing_moved():
    calibration = Calibration("wheel")
    DeviceEmulator(calibration.handle).axis(0, -1.0)
    calibration.answer()
    with pytest.raises(DeviceError, match="No axis moved"):
        calibration.answer()
    assert calibration.step == "right"


@pytest.mark.parametrize(
    "change, message",
    [
        (("takeover:\n- 4\n- 5", "takeover: []"), "takeover must name a button"),
        (("axis: 0", "axis: x"), "axis must be a number"),
        (("centre: 0.0", "centre: 2.0"), "centre must lie between"),
        (("name:", "nam:"), "lacks name"),
        (("dead_zone: 0.02", "dead_zone: 3"), "dead_zone must be"),
        (("hold: false", "hold: 1"), "hold must be true or false"),
    ],
)
def test_a_bad_configuration_is_named(tmp_path, change, message):
    file = tmp_path / "wheel.yml"
    save_config(file, WHEEL)
    text = file.read_text()
    assert change[0] in text
    file.write_text(text.replace(*change))
    with pytest.raises(DeviceError, match=message):
        load_config(file)


# The drive


def test_person_drives_in_the_bounds_of_the_environment():
    _, device, _ = keyboard()
    person = Person(device)
    person.sit_in(spaces.Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32)), steers_left=True)
    assert person.action(1.0, -1.0).tolist() == [-2, 0] and person.action(-1.0, 1.0).tolist() == [2, 10]
    assert person.as_input(np.array([-1.0, 5.0])) == (0.5, 0.0)


def test_what_cannot_be_driven_is_refused():
    with pytest.raises(NotDrivable, match="two bounded actions"):
        check_drivable(gym.make("Pendulum-v1"))


def test_takeover_and_hand_back(tmp_path):
    clock, device, person = keyboard()
    env, _, car = cockpit(tmp_path, device)
    env.env.arm()
    env.reset(seed=1)
    novice = np.array([0.25, 0.25], np.float32)
    assert not env.step(novice)[4]["takeover"]
    person.press(pygame.K_RIGHT)
    clock.now = 5
    assert env.step(novice)[4]["takeover"]
    person.release(pygame.K_RIGHT)
    person.tap(pygame.K_SPACE)
    assert not env.step(novice)[4]["takeover"]
    assert np.allclose(car.executed, [novice, [1, 0], novice])


def test_never_faster_than_real_time(tmp_path):
    _, device, _ = keyboard()
    env, drive, _ = cockpit(tmp_path, device, rate=100.0)
    env.reset(seed=0)
    times = []
    for i in range(10):
        if i == 5:
            time.sleep(0.03)  # what is late is not caught up
        env.step(np.zeros(2, np.float32))
        times.append(drive._next_tick)
    assert np.diff(times).min() >= 0.01


def test_unplugging_in_a_takeover_brakes_and_pauses(tmp_path):
    device, emulator, _ = wheel()
    env, drive, car = cockpit(tmp_path, device)
    env.env.arm()
    env.reset(seed=1)
    emulator.button(4)
    env.step(np.zeros(2, np.float32))
    emulator.unplug()
    results: list = []
    thread = threading.Thread(target=lambda: results.append(env.step(np.zeros(2, np.float32))))
    thread.start()
    wait_until(lambda: drive.paused)
    assert car.speed == 0 and "Braked. No wheel" in drive.message and not results
    drive.go_on()
    assert drive.paused  # nothing to take over with
    emulator.plug()
    drive.go_on()
    thread.join(FOREVER)
    _, _, terminated, truncated, info = results[0]
    assert truncated and not terminated and info["unattended"]
    assert not drive.person.read().takeover
    env.recorder.finish()
    assert len(load_demonstrations(tmp_path / "drive-v0")) == 1  # what the brake did is not recorded


def test_losing_the_device_while_the_novice_drives_pauses_without_braking(tmp_path):
    device, emulator, _ = wheel()
    env, drive, car = cockpit(tmp_path, device)
    env.reset(seed=1)
    emulator.unplug()
    ended: list = []

    def step():
        try:
            env.step(np.zeros(2, np.float32))
        except SessionEnded as error:
            ended.append(error)

    thread = threading.Thread(target=step)
    thread.start()
    wait_until(lambda: drive.paused)
    assert car.executed == []
    drive.quit()
    thread.join(FOREVER)
    assert ended and car.executed == []


def test_a_skipped_episode_is_truncated(tmp_path):
    _, device, _ = keyboard()
    env, drive, _ = cockpit(tmp_path, device)
    env.reset(seed=1)
    drive.pause()
    drive.skip()  # works in a pause, too
    assert env.step(np.zeros(2, np.float32))[2:4] == (False, True)
    assert drive.paused


@pytest.mark.parametrize("command, verdict", [(Command.SUCCESS, True), (Command.FAILURE, False), (Command.SKIP, None)])
def test_the_persons_verdict_ends_the_episode_and_is_stored(command, verdict, tmp_path):
    env, drive, _ = cockpit(tmp_path, keyboard()[1])
    records = []
    env.recorder.on_episode = records.append
    env.reset(seed=1)
    env.step(np.zeros(2, np.float32))
    drive.obey(command)
    assert env.step(np.zeros(2, np.float32))[2:4] == (False, True)
    env.reset(seed=2)
    assert not env.step(np.zeros(2, np.float32))[3]
    summary = env.recorder.finish()
    assert [record.verdict for record in records] == [verdict, None]
    assert (summary.called_success, summary.called_failure) == (verdict is True, verdict is False)
    first, second = minari.load_dataset(tmp_path / "drive-v0").iterate_episodes()
    assert first.infos["verdict"].tolist() == [0, 0, {True: 1, False: -1, None: 0}[verdict]]
    assert not second.infos["verdict"].any()


def test_keys_for_a_verdict():
    window, drive = Window("test"), Session(Person(keyboard()[1]))
    window.drive = drive
    for key, wanted in ((pygame.K_g, (True, True)), (pygame.K_f, (True, False)), (pygame.K_n, (True, None))):
        window.handle(pygame.event.Event(pygame.KEYDOWN, key=key))
        assert drive.take_skip() == wanted and drive.take_skip() == (False, None)
    window.close()


# Learning beside the drive


def make_driven(algorithm, tmp_path, device=None, car=None, rate=1000.0, **kwargs):
    env, drive, car = cockpit(tmp_path, device or keyboard()[1], car, rate)
    model = make_guided(driven(algorithm), DummyVecEnv([lambda: env]), **kwargs)
    model.attach(drive)
    return model, drive, env


@pytest.mark.parametrize("algorithm", [PVP, DPVP, CHAC])
def test_as_many_updates_as_the_algorithm_makes(algorithm, tmp_path):
    model, _, env = make_driven(algorithm, tmp_path, train_freq=2, gradient_steps=3)
    model.learn(60)
    assert model._n_updates == 3 * len(range(22, 61, 2)) and model.owed_steps == 0
    assert model.replay_buffer.size() == 60
    for driving, learned in zip(*model._pairs, strict=True):
        assert (driving == learned).all()
    env.recorder.finish()


@pytest.mark.parametrize("algorithm", [PVP, DPVP, CHAC])
def test_a_novice_that_is_not_to_learn_stays_as_it_is_and_does_not_explore(algorithm, tmp_path):
    model, drive, env = make_driven(algorithm, tmp_path, learning_starts=10**6)
    drive.learns = False
    before = parameters(model)
    model.learn(40)
    assert model._n_updates == model.owed_steps == 0
    assert all((value == before[name]).all() for name, value in model.policy.state_dict().items())
    executed = env.unwrapped.executed
    proposed = [model.predict(np.array([3.0, step], np.float32), deterministic=True)[0] for step in range(2)]
    assert np.allclose(executed[0], proposed[0]) and len(executed) == 40
    env.recorder.finish()


@pytest.mark.parametrize("meter", [True, False])
def test_the_meter_can_be_left_out(meter, tmp_path):
    model, drive, env = make_driven(PVP, tmp_path)
    drive.meter = meter
    model.learn(120)
    assert (drive.display.novice.risk is not None) == meter
    env.recorder.finish()


@pytest.mark.parametrize("algorithm", [PVP, DPVP, CHAC])
@pytest.mark.parametrize("meter", [True, False])
def test_a_takeover_tells_what_it_has_taught(algorithm, meter, tmp_path):
    _, device, person = keyboard()
    model, drive, env = make_driven(algorithm, tmp_path, device, Car(length=10**6))
    drive.meter = meter
    step_of_car = env.step

    def step(action):
        if drive.totals.total_steps in (60, 75):
            assert drive.display.novice.lesson is None or drive.totals.total_steps == 75
            person.tap(pygame.K_SPACE)
        return step_of_car(action)

    env.step = step
    model.learn(150)
    lesson = drive.display.novice.lesson
    if not meter:
        assert lesson is None
    else:
        observation, person_action, novice_action = model._lesson_of
        assert observation[0, 1] == 60 and np.allclose(person_action, [[0, 0]]) and 0 <= lesson.alike <= 75
        assert np.allclose(env.unwrapped.executed[60], [0, 0])
        now = model._tell_lesson(None)  # the last step may have taught, too
        values = [model._guided_value(observation, action) for action in (person_action, novice_action)]
        assert [now.person, now.novice] == pytest.approx(np.subtract(values, model._lesson.before)) and any(now[:2])
        assert dict(indicators(drive.display, drive.totals, 0))["taught"] == str(lesson)
    env.recorder.finish()


def test_who_may_only_watch_never_drives(tmp_path):
    _, device, emulator = keyboard()
    env, drive, car = cockpit(tmp_path, device)
    drive.person.may_take_over = False
    env.env.arm()
    env.reset(seed=1)
    emulator.press(pygame.K_UP)
    _, _, _, _, info = env.step(np.array([0.25, 0.0], np.float32))
    assert not info["takeover"] and np.allclose(car.executed[-1], [0.25, 0.0])


def test_slow_updates_do_not_hold_up_the_drive(tmp_path):
    model, drive, _ = make_driven(DPVP, tmp_path, rate=50.0)
    train_now, begun_at = model.train_now, []

    def slowly(*args):
        """As long as 12 steps: it would never be done if they waited for it."""
        begun_at.append(drive.totals.total_steps)
        wait_until(lambda: drive.totals.total_steps >= begun_at[-1] + 12 or drive.ended)
        train_now(*args)
        if len(begun_at) >= 4:
            drive.quit()

    model.train_now = slowly
    model.learn(10_000)
    assert len(begun_at) >= 4 and np.diff(begun_at[:4]).min() >= 12 and drive.lag > 30


def test_an_error_of_an_update_ends_the_drive(tmp_path):
    model, _, _ = make_driven(DPVP, tmp_path)

    def fail(*args):
        raise ArithmeticError("broken")

    model.train_now = fail
    with pytest.raises(ArithmeticError, match="broken"):
        model.learn(1000)


def test_stage_2_is_prepared_beside_the_drive_and_the_person_may_still_take_over(tmp_path):
    _, device, person = keyboard()
    model, drive, env = make_driven(CHAC, tmp_path, device, rate=100.0, switch_after=30, prefit_steps=20)
    prefit_step, prepared = model._prefit_step, []
    step, step_of_car = 0, env.step  # of those that are made while stage 2 is prepared

    def witnessed():
        """While a step of the car is made, and after it."""
        prepared.append((threading.current_thread() is model.learner, drive.busy, drive.totals.total_steps))
        if len(prepared) == 10:
            person.tap(pygame.K_SPACE)
        wait_until(lambda: drive.totals.total_steps > prepared[-1][2])
        prefit_step()

    def in_turn(action):
        """However slow the learner is, the car is at most one step ahead."""
        nonlocal step
        if model.prefit_left:
            wait_until(lambda: not model.prefit_left or step <= len(prepared))
            step += 1
        return step_of_car(action)

    model._prefit_step, env.step = witnessed, in_turn
    model.learn(80)
    assert model.stage == 2 and len(prepared) == 20 and model.owed_steps == 0
    assert all(is_beside and not busy for is_beside, busy, _ in prepared)
    assert prepared[0][2] >= 30 and prepared[-1][2] > prepared[0][2] + 5  # stage 1 went on meanwhile
    assert model._n_updates == 80 - model.learning_starts
    assert 10 < model.counts["human_steps"] < 50  # none before the switch, until the episode ended
    assert drive.display.novice.stage == "2: self-learning" and 0 <= drive.display.novice.confidence <= 1
    assert 0 <= drive.display.novice.risk <= 1
    env.recorder.finish()


def test_what_is_saved_is_the_algorithms(tmp_path):
    model, _, env = make_driven(DPVP, tmp_path)
    model.learn(40)
    model.save(tmp_path / "model.zip")
    loaded = DPVP.load(tmp_path / "model.zip")
    observation = np.zeros(2, np.float32)
    assert type(loaded) is DPVP
    assert np.array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    env.recorder.finish()


def test_the_unattended_brake_is_not_learned_from(tmp_path):
    device, emulator, _ = wheel()
    model, drive, env = make_driven(DPVP, tmp_path, device, rate=200.0)
    thread = threading.Thread(target=lambda: model.learn(10_000), daemon=True)
    thread.start()
    wait_until(lambda: drive.totals.total_steps >= 2)
    emulator.button(4)
    wait_until(lambda: drive.totals.human_steps >= 3)
    emulator.unplug()
    wait_until(lambda: drive.paused)
    drive.quit()
    thread.join(FOREVER)
    summary = env.recorder.finish()
    assert model.replay_buffer.size() == summary.steps
    assert (model.replay_buffer.human.arrays["action"][: summary.human_steps, 1] == 0).all()  # the person did not brake


# Recordings


def test_recording_survives_a_kill_up_to_the_last_episode(tmp_path):
    _, device, _ = keyboard()
    env, _, _ = cockpit(tmp_path, device, Car(length=4))
    for _ in range(2):
        env.reset()
        while not env.step(np.zeros(2, np.float32))[2]:
            pass
    env.reset()
    env.step(np.zeros(2, np.float32))  # of the third nothing is on the disk
    assert sorted(file.name for file in (tmp_path / FOLDER).glob("*.npz")) == ["000000.npz", "000001.npz"]


def test_a_drive_is_a_dataset_to_learn_from(tmp_path):
    _, device, person = keyboard()
    env, _, _ = cockpit(tmp_path, device, Car(length=6))
    env.env.arm()
    novice = np.array([0.25, 0.0], np.float32)
    env.reset(seed=1)
    for step in range(6):
        if step in (2, 4):
            person.tap(pygame.K_SPACE)
        env.step(novice)
    summary = env.recorder.finish()
    assert (summary.episodes, summary.steps, summary.human_steps, summary.takeovers) == (1, 6, 2, 1)
    assert (summary.cost, summary.human_cost, summary.mean_takeover_steps) == (3.0, 1.0, 2.0)
    data = load_demonstrations(tmp_path / "drive-v0")
    assert data.takeovers.tolist() == [False, False, True, True, False, False]
    assert np.allclose(data.novice_actions, novice) and np.allclose(data.actions[2:4], 0)

    for algorithm in (DPVP, CHAC):
        model = make_guided(algorithm)
        model.observation_space = data.observation_space
        model.store_demonstrations(data)
        assert (len(model.replay_buffer.human), len(model.replay_buffer.novice)) == (2, 4)
        assert model.replay_buffer.human.arrays["takeover_start"][:2, 0].tolist() == [1, 0]
        assert np.allclose(model.replay_buffer.human.arrays["novice_action"][:2], novice)
    dagger = HGDagger("MlpPolicy", DummyVecEnv([Car]), dataset=data)
    assert dagger.demonstrated_rows == 2


# The command


def test_drive_with_keys_then_resume_and_replay(tmp_path, monkeypatch, capsys):
    """The whole command: a window, a takeover with keys, quit; then the drive goes on where it was."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    frames = play(monkeypatch, [(5, pygame.K_UP), (12, pygame.K_q)])
    command = ["drive", "--algo", "pvp", "--seed", "1", "--device", "keyboard", "--rate", "50", "--go"]
    main_with(monkeypatch, *command, "--dataset", "drives/first-v0")
    printed = capsys.readouterr().out
    assert "in 1 takeovers" in printed and "--resume logs/pvp/SafeDrive-v0_1" in printed and len(frames) > 0

    play(monkeypatch, [(25, pygame.K_q)])
    main_with(monkeypatch, "drive", "--resume", "logs/pvp/SafeDrive-v0_1")
    second = re.search(r"minari/(drives/pvp-SafeDrive-.*-v0)", capsys.readouterr().out)[1]
    model = PVP.load("logs/pvp/SafeDrive-v0_2/SafeDrive-v0.zip")
    assert model.counts["total_steps"] >= 20 and model.counts["human_steps"] >= 5
    checkpoint, _ = sound_checkpoint(tmp_path / "logs/pvp/SafeDrive-v0_2/checkpoints")
    model.load_replay_buffer(checkpoint / "replay_buffer.pkl")
    assert model.replay_buffer.size() == model.counts["total_steps"]

    main_with(monkeypatch, "demos", "replay", "--dataset", second)
    assert "the returns differ by 0, the observations by 0" in capsys.readouterr().out

    with pytest.raises(SystemExit):
        main_with(monkeypatch, *command, "--dataset", "drives/first-v0")
    assert "--dataset drives/first-v0 exists already" in capsys.readouterr().err
    assert len(list((tmp_path / "logs/pvp").iterdir())) == 2


def play(monkeypatch, script):
    """
    :param script: (steps of the training after the key before, key)
    """
    todo, frames, draw = list(script), [], Window.draw
    last_press = 0

    def draw_and_press(window):
        nonlocal last_press
        draw(window)
        frames.append(pygame.surfarray.array3d(window.screen).std())
        steps = window.drive.totals.total_steps
        if todo and steps >= last_press + todo[0][0]:
            DeviceEmulator().press(todo.pop(0)[1])
            last_press = steps  # on a busy machine few steps are drawn: the next key must not follow at once

    monkeypatch.setattr(Window, "draw", draw_and_press)
    return frames


def main_with(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["sb3-chac", *arguments])
    main()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--algo", "sac_lag"], "does not learn from takeovers, choose from"),
        (["--env", "Nowhere-v0"], "gymnasium knows no 'Nowhere-v0'"),
        (["--env", "Pendulum-v1"], "two bounded actions"),
        (["--pretrain", "5"], "--pretrain needs --demos"),
        (["--rate", "0"], "--rate must be from"),
        (["--query", "1.5"], "--query must be above 0"),
        (["--query", "0.9", "--no-meter"], "leave out --no-meter"),
        (["--force-feedback", "2"], "--force-feedback must be above 0"),
        (["--force-feedback", "0.3", "--serve", "8000"], "--force-feedback is for a wheel"),
        (["--no-learning"], "--no-learning needs a model"),
        (["--config", "nothing.yml"], "nothing.yml cannot be read"),
        (["--resume", "nowhere"], "there is no such folder"),
        (["--recover", "nowhere"], "holds no recording"),
        (["--demos", "none/none-v0"], "There is no dataset 'none/none-v0'"),
    ],
)
def test_wrong_arguments_get_one_message(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.delenv("SB3_CHAC_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as ended:
        main_with(monkeypatch, "drive", *arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
