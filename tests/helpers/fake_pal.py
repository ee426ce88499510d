"""The maker's `pal.products.qcar` with its signatures and its habit: an error of the hardware is
printed and swallowed, and the buffers keep what they held."""

import threading
from types import ModuleType

import numpy as np


class Hardware:
    """What the driver talks to. `fails`: every call is an error; `hangs`: reads wait for it."""

    def __init__(self):
        self.fails = False
        self.hangs: threading.Event | None = None
        self.random = np.random.default_rng(0)
        self.throttle = self.steering = 0.0
        self.tach_mps = 0.0
        self.encoder = 0
        self.pictures = True
        self.calls: list[str] = []

    def write(self, throttle, steering):
        self.calls.append("write")
        if not self.fails:
            self.throttle, self.steering = throttle, steering

    def read(self):
        self.calls.append("read")
        if self.hangs is not None:
            self.hangs.wait(5.0)
        return not self.fails


def fake_pal(hardware: Hardware) -> dict[str, ModuleType]:
    """Modules for `sys.modules`."""

    class QCar:
        def __init__(self, readMode=0, frequency=500, pwmLimit=0.3, steeringBias=0):
            self.readMode, self.frequency, self.pwmLimit = readMode, frequency, pwmLimit
            self.readEncoderBuffer = np.zeros(1, np.int32)
            self.readOtherBuffer = np.zeros(4)
            self.motorEncoder = np.zeros(1, np.int32)
            self.motorTach = np.zeros(1)
            self.gyroscope = np.zeros(3)
            hardware.car = self

        def read_write_std(self, throttle, steering, LEDs=None):
            self.write(throttle, steering, LEDs)
            self.read()

        def write(self, throttle, steering, LEDs=None):
            limit = self.pwmLimit
            hardware.write(np.clip(throttle, -limit, limit), np.clip(steering, -0.6, 0.6))

        def read(self):
            if hardware.read():
                self.readEncoderBuffer[0] = hardware.encoder
                self.readOtherBuffer[:3] = 0.01 * hardware.random.standard_normal(3)
                self.readOtherBuffer[3] = hardware.tach_mps
            else:
                print("It was not possible to read")
            self.motorEncoder = self.readEncoderBuffer
            self.gyroscope = self.readOtherBuffer[0:3]
            self.motorTach = self.readOtherBuffer[-1] * 1.0

        def terminate(self):
            hardware.calls.append("terminate")
            hardware.write(0, 0)

    class Camera2D:
        def __init__(self, frameWidth, frameHeight, frameRate):
            self.imageData = np.zeros((frameHeight, frameWidth, 3), np.uint8)
            self.terminated = False

        def read(self):
            if not hardware.pictures:
                print("Media error")
                return False
            self.imageData[::41] = hardware.random.integers(0, 255, 3)
            return True

        def terminate(self):
            self.terminated = True

    class QCarCameras:
        def __init__(
            self,
            frameWidth=820,
            frameHeight=410,
            frameRate=30,
            enableRight=False,
            enableBack=False,
            enableLeft=False,
            enableFront=False,
        ):
            enabled = (enableRight, enableBack, enableLeft, enableFront)
            self.csi = [
                Camera2D(frameWidth, frameHeight, frameRate) if on else None for on in enabled
            ]
            self.csiRight, self.csiBack, self.csiLeft, self.csiFront = self.csi
            hardware.cameras = self

        def readAll(self):
            for camera in self.csi:
                if camera is not None:
                    camera.read()

    module = ModuleType("pal.products.qcar")
    module.QCar, module.QCarCameras = QCar, QCarCameras
    pal, products = ModuleType("pal"), ModuleType("pal.products")
    pal.products, products.qcar = products, module
    return {"pal": pal, "pal.products": products, "pal.products.qcar": module}
