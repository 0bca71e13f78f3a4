"""The data that stages pass to each other: recordings, motions, noise and calibrations (frozen dataclasses).

The package has the public names of its modules, and those of ``imu_logs`` that come with them.
"""

from imu_logs.log import Index as Index
from imu_logs.log import Integers as Integers
from imu_logs.log import Mask as Mask
from imu_logs.log import Note as Note
from imu_logs.log import Values as Values
from imu_logs.units import AXES as AXES
from imu_logs.units import SENSOR_UNITS as SENSOR_UNITS
from imu_logs.units import SENSORS as SENSORS
from pipeline.core.records.budget import *  # noqa: F403
from pipeline.core.records.calibration import *  # noqa: F403
from pipeline.core.records.evaluation import *  # noqa: F403
from pipeline.core.records.recording import *  # noqa: F403
