"""Write clips as H.264 with the times and the sound of the original."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import av
from av.audio.stream import AudioStream
from av.video.stream import VideoStream

from spackle.clips.files import Clip
from spackle.video.encoding import StreamEncoder, VideoWriter
from spackle.video.video_formats import H264

TIME_UNIT = Fraction(1, 90_000)  # of written times, in seconds; usual for MPEG
# Lowest and highest frame rate that an encoder accepts.
MIN_FRAME_RATE, MAX_FRAME_RATE = Fraction(1, 1000), Fraction(1000)
MAX_RATE_DENOMINATOR = 1001  # rates such as 30000/1001 are exact


class ClipWriter(VideoWriter):
    """Writes an .mp4 with the times and the sound of a clip; it appears if the block succeeds."""

    def __init__(self, path: str | os.PathLike[str], clip: Clip) -> None:
        super().__init__(path)
        self.clip = clip

    @property
    def sound_was_copied(self) -> bool:
        """Whether the file has sound so far."""
        return isinstance(self.encoder, _ClipEncoder) and self.encoder.sound_was_copied

    def make_encoder(self, height: int, width: int) -> StreamEncoder:
        """Open the encoder for frames of this size in pixels, once the first frame has come."""
        return _ClipEncoder(self.temporary_path, width, height, self.clip)


class _ClipEncoder(StreamEncoder):
    """Encodes frames at evenly spaced times, and then gives the packets the clip's times.

    Sound is copied as it is, packet by packet, up to the time of the last written frame, because
    players want sound and picture of one time near each other in the file.
    """

    def __init__(self, path: Path, width: int, height: int, clip: Clip) -> None:
        """Open the file at `path` for frames of this size in pixels, and the clip for its sound."""
        # The encoder gets evenly spaced frames, at the mean frame rate of the clip. Their packets
        # then get the times of the clip, which may be uneven.
        rate = clip.rate.limit_denominator(MAX_RATE_DENOMINATOR)
        self._encoder_rate = min(max(rate, MIN_FRAME_RATE), MAX_FRAME_RATE)
        super().__init__(H264, path, width, height, self._encoder_rate, play_count=1)
        self._clip = clip
        self.sound_was_copied = False

        # An mp4 can hold only some kinds of sound.
        self._sound_file = None
        if clip.audio in self.container.supported_codecs:
            self._sound_file = av.open(str(clip.path), metadata_errors="replace")
        if self._sound_file is not None:
            source = self._sound_file.streams.audio[0]
            self._sound_stream = self.container.add_stream_from_template(source)
            self._sound_packets = self._sound_file.demux(source)
            # A packet that was read, but belongs after the frames that are written so far.
            self._pending_sound: av.Packet[AudioStream] | None = None

    def finish(self) -> None:
        """Write the last frames and the rest of the sound, and close the file."""
        self.write_packets(self.stream.encode(None))
        self._copy_sound(self._clip.seconds)
        self.close()

    def close(self) -> None:
        """Close the file, and the clip from which the sound is copied."""
        super().close()
        if self._sound_file is not None:
            self._sound_file.close()

    def write_packets(self, packets: list[av.Packet[VideoStream]]) -> None:
        """Write encoded frames with the times of the clip's frames."""
        for packet in packets:
            assert packet.time_base is not None
            assert packet.pts is not None
            assert packet.dts is not None
            # A packet has the time at which its frame is shown (pts), and the time at which it is
            # decoded (dts), which can be earlier. The encoder's times are evenly spaced, so that
            # each of them tells the number of a frame, and is replaced by that frame's time.
            shown_frame = round(packet.pts * packet.time_base * self._encoder_rate)
            decoded_frame = round(packet.dts * packet.time_base * self._encoder_rate)
            decoding_time = self._frame_time(decoded_frame)
            packet.time_base = TIME_UNIT
            packet.pts = round(self._frame_time(shown_frame) / TIME_UNIT)
            packet.dts = round(decoding_time / TIME_UNIT)
            packet.duration = 0  # means: until the next frame is shown
            self._copy_sound(decoding_time)
            self.container.mux(packet)

    def _frame_time(self, index: int) -> Fraction:
        """The time in seconds of the frame with this number, from the clip's own times.

        The number may lie beyond the clip's frames: a packet may be decoded some frames before its
        frame is shown, so that the first packet is decoded at a frame such as -2. Beyond both ends,
        times go on at the encoder's frame rate.
        """
        times = self._clip.times
        if index < 0:
            return times[0] + index / self._encoder_rate
        if index >= len(times):
            return times[-1] + (index - len(times) + 1) / self._encoder_rate
        return times[index]

    def _copy_sound(self, until: Fraction) -> None:
        """Copy the clip's sound up to a time in seconds; stop at the first damaged packet."""
        while self._sound_file is not None:
            try:
                packet = self._pending_sound or next(self._sound_packets, None)
            except av.FFmpegError:
                return
            if packet is None or packet.pts is None or packet.time_base is None:
                return

            # A packet's time is in ticks of its stream. From now on, it counts from the first
            # frame of the video.
            clip_start_ticks = round(self._clip.start / packet.time_base)
            sound_start_ticks = packet.pts - clip_start_ticks
            sound_end_ticks = sound_start_ticks + (packet.duration or 0)
            if sound_start_ticks * packet.time_base >= until:
                self._pending_sound = packet
                return
            self._pending_sound = None
            if sound_end_ticks <= 0:  # before the first frame
                continue
            packet.pts = sound_start_ticks
            if packet.dts is not None:
                packet.dts -= clip_start_ticks
            packet.stream = self._sound_stream
            self.container.mux(packet)
            self.sound_was_copied = True
