#!/bin/bash
# systemd.sh FOLDER USR UNIT: a systemd of its own starts, stops and restarts UNIT, installed with PREFIX=/usr into USR;
# what came of it is FOLDER/log. As root: namespaces, an overlay of this machine's root that is thrown away, and nothing of
# this machine's own systemd, where there is one.
set -e
folder=$1 usr=$2 unit=$3

if [ "$4" != inside ]; then
  # A control group of its own, which is the root of all that systemd sees.
  made=
  for top in /sys/fs/cgroup /sys/fs/cgroup/systemd /sys/fs/cgroup/unified; do
    [ -w $top/cgroup.procs ] || continue
    made="$made $top/fbard-test-$$"
    mkdir $top/fbard-test-$$
    echo $$ > $top/fbard-test-$$/cgroup.procs
  done
  clean() {
    for group in $made; do
      echo $$ > ${group%/*}/cgroup.procs
      find $group -depth -type d -exec rmdir {} \; || :
    done
  }
  trap clean EXIT
  # A terminal: /dev/console must be one.
  timeout -k 5 120 script -qec "unshare --mount --pid --fork --cgroup --uts --ipc --net --kill-child $0 $* inside" "$folder/console" > /dev/null < /dev/null
  exit
fi

mount --make-rprivate /
root=$folder/root
mkdir -p $root $folder/layers
mount -t tmpfs tmpfs $folder/layers
mkdir $folder/layers/upper $folder/layers/work
mount -t overlay overlay -o lowerdir=/,upperdir=$folder/layers/upper,workdir=$folder/layers/work $root
mount -t proc proc $root/proc
mount -t sysfs -o ro sysfs $root/sys
if [ "$(stat -fc %T /sys/fs/cgroup)" = cgroup2fs ]; then
  mount -t cgroup2 cgroup2 $root/sys/fs/cgroup
else
  mount -t tmpfs tmpfs $root/sys/fs/cgroup
  mkdir $root/sys/fs/cgroup/systemd $root/sys/fs/cgroup/unified
  mount -t cgroup -o none,name=systemd systemd $root/sys/fs/cgroup/systemd
  mount -t cgroup2 cgroup2 $root/sys/fs/cgroup/unified
fi
for empty in run tmp dev; do mount -t tmpfs tmpfs $root/$empty; done
for device in null zero full random urandom tty; do
  touch $root/dev/$device
  mount --bind /dev/$device $root/dev/$device
done
mkdir $root/dev/{shm,pts,mqueue}
mount -t tmpfs tmpfs $root/dev/shm
mount -t devpts devpts $root/dev/pts
mount -t mqueue mqueue $root/dev/mqueue
ln -s pts/ptmx $root/dev/ptmx
touch $root/dev/console
mount --bind "$(tty)" $root/dev/console
mount --bind $folder $root/mnt

cp -a $usr/. $root/usr/
rm -rf $root/etc/systemd/system/*
cp $unit $root/etc/systemd/system/fbard.service
cat > $root/etc/systemd/system/test.service <<X
[Unit]
DefaultDependencies=no
SuccessAction=exit-force
FailureAction=exit-force
[Service]
Type=oneshot
ExecStart=/usr/bin/bash /mnt/session
StandardOutput=file:/mnt/log
StandardError=file:/mnt/session.err
TimeoutStartSec=90
X
cat > $folder/session <<'X'
# Lines "what: value" for the test.
ip link set lo up
property() { systemctl show -P $1 fbard.service; }
tell() {
  echo "$1: $(property ActiveState)"
  fbar --json show long > /mnt/$1.json
}
systemctl start fbard.service; echo "start: $?"
echo "user: $(ps -o uid= -p $(property MainPID))"
fbar run dam-break --id long --set time.end=1000 --detach > /dev/null
sleep 1; tell first
systemctl stop fbard.service; echo "stop: $?"
echo "stop.result: $(property Result) $(property ExecMainStatus)"
systemctl start fbard.service; echo "start.again: $?"
sleep 1; tell second
kill -9 $(property MainPID); sleep 5; tell third
echo "restarts: $(property NRestarts)"
systemctl stop fbard.service
X
echo > $root/etc/fstab
systemd-id128 new > $root/etc/machine-id
cd $root
mkdir -p before
pivot_root . before
cd /
umount -l /before
exec env -i container=fbard-test PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system --unit=test.service --show-status=0
